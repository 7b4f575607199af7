"""``Backend.take_rows``: the rows of several arrays in another order."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pipeline.render.backend import Backend

COUNT = 3000


def arrays() -> dict[str, Tensor]:
    """Arrays whose rows have 2 to 192 bytes."""
    draws = torch.Generator().manual_seed(3)
    shapes = {"one": (COUNT,), "three": (COUNT, 3), "four": (COUNT, 4), "sh": (COUNT, 16, 3)}
    found = {name: torch.randn(*shape, generator=draws) for name, shape in shapes.items()}
    found["bands"] = torch.randn(COUNT, 9, 3, generator=draws)
    found["steps"] = torch.arange(COUNT, dtype=torch.int32)
    return found | {"halves": found["three"].to(torch.bfloat16)}


@pytest.mark.parametrize("count", [0, 1, 1000, 5000])
def test_rows_are_taken_and_zeroed(backend: Backend, count: int) -> None:
    draws, sources = torch.Generator().manual_seed(4), arrays()
    rows = torch.randint(0, COUNT, (count,), generator=draws)
    zeroed = torch.rand(count, generator=draws) < 0.2
    for threads in (1, 2, 5):
        plain = backend.take_rows(sources, rows, threads=threads)
        some = backend.take_rows(sources, rows, zeroed, threads)
        for name, tensor in sources.items():
            assert torch.equal(plain[name], tensor[rows]), name
            assert torch.equal(some[name][~zeroed], tensor[rows][~zeroed]), name
            assert not some[name][zeroed].any(), name
            assert some[name].dtype == tensor.dtype


def test_the_results_are_copies(backend: Backend) -> None:
    sources = arrays()
    taken = backend.take_rows(sources, torch.arange(COUNT))
    taken["three"] += 1
    assert not torch.equal(taken["three"], sources["three"])


def test_invalid_rows_are_errors() -> None:
    from pipeline.render import make_backend

    backend, sources = make_backend("cpu"), arrays()
    for rows in (torch.tensor([0, COUNT]), torch.tensor([-1])):
        with pytest.raises(IndexError):
            backend.take_rows(sources, rows)
    rows = torch.arange(4)
    with pytest.raises(ValueError, match="int64"):
        backend.take_rows(sources, rows.int())
    with pytest.raises(ValueError, match="one for each"):
        backend.take_rows(sources, rows, torch.ones(3, dtype=torch.bool))
    with pytest.raises(ValueError, match="as many rows"):
        backend.take_rows({**sources, "few": torch.ones(4)}, rows)
    with pytest.raises(ValueError, match="contiguous"):
        backend.take_rows({"turned": torch.ones(3, COUNT).t()}, rows)
