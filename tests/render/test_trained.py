"""Rows of Gaussians in the memory of a device: copies of them, and those that are not finite."""

from __future__ import annotations

import math
from collections import Counter

import pytest
import torch

from pipeline.render.gpu import layout
from pipeline.render.gpu.backend import GpuBackend
from pipeline.render.gpu.counts import Counts
from pipeline.render.gpu.trained import Trained
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.resident import Optimised, Part
from tests.render.test_resident import State
from tests.tools import need_gpu

COUNT = 400
# The bytes of a Gaussian with three SH bands: parameters, moments, ``last`` and statistics.
GEOMETRY, ALL = 4 * (11 + 2), 4 * (59 + 2 * 10 + 24 + 16 + 1 + 2)


def drawn(embedding: tuple[float, ...] | None = (0.7, -1.2)) -> Optimised:
    """Gaussians with random moments and statistics."""
    optimised = State(embedding).optimised
    draws = torch.Generator().manual_seed(0)
    for moments in (optimised.first, optimised.second):
        for tensor in moments.values():
            tensor.copy_(torch.rand(tensor.shape, generator=draws))
    optimised.last.copy_(torch.randint(0, 99, (COUNT,), generator=draws))
    optimised.seen.copy_(torch.rand(COUNT, generator=draws))
    return optimised


def with_rows(optimised: Optimised, count: int) -> Optimised:
    """Tensors of another number of Gaussians, without values."""
    found = {
        name: {k: t.new_empty(count, *t.shape[1:]) for k, t in value.items()}
        if isinstance(value, dict)
        else value.new_empty(count)
        for name, value in vars(optimised).items()
    }
    return Optimised(**found)  # type: ignore[arg-type]


@pytest.fixture
def trained() -> Trained:
    need_gpu()
    backend = GpuBackend()
    backend.gpu.counts = Counts()
    return Trained(Workspace(backend.gpu))


def flat(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.reshape(len(tensor), math.prod(tensor.shape[1:]))


def test_selected_rows_are_copies_or_blank(trained: Trained) -> None:
    """In any order and number. Only moments have blank rows; rows that become longer are filled
    with zeros."""
    before, draws = drawn(), torch.Generator().manual_seed(1)
    trained.load(before, Part.ALL)
    row = with_rows(before, 1)
    for arrays in (row.parameters, row.first, row.second):
        sh = arrays["sh"]
        arrays["sh"] = sh.new_empty(1, 25, sh.shape[2])  # type: ignore[index]
    for number, moments in enumerate((row.first, row.second)):
        for tensor in moments.values():
            tensor.copy_(number + torch.rand(tensor.shape, generator=draws))
    rows = torch.randint(0, COUNT, (650,), generator=draws)
    blank = torch.rand(650, generator=draws) < 0.3
    trained.select(rows, blank, row)
    loaded, found = with_rows(row, 650), with_rows(row, 650)
    for tensor in (loaded.gradient_sum, loaded.seen, *loaded.parameters.values()):
        tensor.copy_(torch.rand(tensor.shape, generator=draws))
    trained.load(loaded, Part.GEOMETRY)
    trained.store(found, Part.ALL)
    assert torch.equal(found.last, before.last[rows])
    assert torch.equal(found.gradient_sum, loaded.gradient_sum)
    assert torch.equal(found.seen, loaded.seen)
    for name in layout.GEOMETRY:
        assert torch.equal(found.parameters[name], loaded.parameters[name]), name
    for each in ("parameters", "first", "second"):
        for name, tensor in getattr(found, each).items():
            if each == "parameters" and name in layout.GEOMETRY:
                continue
            expected, old = torch.zeros_like(flat(tensor)), flat(getattr(before, each)[name])
            expected[:, : old.shape[1]] = old[rows]
            if each != "parameters":
                expected[blank] = flat(getattr(row, each)[name])
            assert torch.equal(flat(tensor), expected), f"{each} {name}"


def test_colours_that_are_not_finite_are_found(trained: Trained) -> None:
    optimised = drawn()
    optimised.parameters["sh"][3, 15, 2] = math.nan
    optimised.parameters["sh"][COUNT - 1, 0, 0] = -math.inf
    optimised.parameters["appearance"][7, 1, 2] = math.inf
    optimised.parameters["sh"][9] = torch.finfo(torch.float32).max
    trained.load(optimised, Part.ALL)
    assert torch.nonzero(trained.bad_colors())[:, 0].tolist() == [3, 7, COUNT - 1]


def test_density_control_moves_few_bytes(trained: Trained) -> None:
    """Geometry, statistics and a mark of bad colours to the processor, and geometry, statistics and
    numbers of rows back, instead of all tensors each way."""
    optimised = drawn(None)
    counts = trained.gpu.counts
    trained.load(optimised, Part.ALL)
    assert counts.uploaded.total() == ALL * COUNT
    counts.uploaded, counts.downloaded = Counter(), Counter()
    trained.store(optimised, Part.GEOMETRY)
    trained.bad_colors()
    assert counts.downloaded.total() == (GEOMETRY + 4) * COUNT
    trained.select(
        torch.arange(COUNT), torch.zeros(COUNT, dtype=torch.bool), with_rows(optimised, 1)
    )
    trained.load(optimised, Part.GEOMETRY)
    row = ALL - GEOMETRY
    uniforms = 28 * 12 + 8  # Sizes and offsets of the sections, and of the search.
    assert counts.uploaded.total() <= (GEOMETRY + 4) * COUNT + row + uniforms
