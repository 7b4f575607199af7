"""Files of Gaussians by suffix, handling of values that are not finite, and export filters."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.io.splat_files import SUFFIXES, read_gaussians, write_gaussians
from pipeline.runtime.errors import UserError
from pipeline.splats import arrays
from pipeline.splats.morton import in_morton_order
from pipeline.splats.reduce import reduce_gaussians
from tests.io.test_sog import OURS as SOG
from tests.splats.samples import Within, sample

#: The coarsest of the other formats.
ALL = Within(2**-19, 0.032, 0.5001 / 255, 0.91, 0.014, 0.5001 / 128)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_is_written_and_read_by_its_suffix(tmp_path, suffix) -> None:
    path = tmp_path / f"a{suffix.upper()}"
    write_gaussians(path, sample(20, 0))
    warnings: list[str] = []
    within = SOG if suffix == ".sog" else ALL
    within.check(read_gaussians(path, warnings), sample(20, 0))
    assert not warnings


@pytest.mark.parametrize(
    "change",
    [{"means": np.float32(1)}, {"sh": np.zeros(3)}, {"sh": np.zeros((5, 25, 3))}, {"quats": "w"}],
)
def test_an_archive_of_something_else_is_an_error(tmp_path, change) -> None:
    np.savez(tmp_path / "a.npz", **(sample(5).arrays() | change))
    with pytest.raises(UserError, match="Gaussians"):
        read_gaussians(tmp_path / "a.npz", [])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_truncation_is_an_error_that_names_the_file(tmp_path, suffix) -> None:
    path = tmp_path / f"a{suffix}"
    write_gaussians(path, sample(1, 0))
    whole = path.read_bytes()
    for length in range(0, len(whole), 11):
        path.write_bytes(whole[:length])
        with pytest.raises(UserError, match="expected") as caught:
            read_gaussians(path, [])
        assert caught.value.file == path


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=100, derandomize=True, deadline=None)
@given(data=st.data())
def test_damaged_files_are_read_or_user_errors(tmp_path_factory, suffix, data) -> None:
    path = tmp_path_factory.mktemp("damaged") / f"a{suffix}"
    write_gaussians(path, sample(1, 0))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        assert len(read_gaussians(path, [])) >= 1
    except UserError as error:
        assert error.file == path


def test_an_unknown_suffix_is_an_error(tmp_path) -> None:
    with pytest.raises(UserError, match=r"'\.obj'"):
        write_gaussians(tmp_path / "a.obj", sample())
    with pytest.raises(UserError, match=r"\.ply, \.spz"):
        read_gaussians(tmp_path / "a", [])


def test_gaussians_that_are_not_finite_are_left_out_with_a_warning(tmp_path) -> None:
    gaussians = sample(10, 1)
    gaussians.means[2, 1] = np.nan
    gaussians.sh[3, 1, 0] = np.inf
    gaussians.quats[4] = 0
    gaussians.opacity_logits[5] = np.nan
    gaussians.opacity_logits[6] = np.inf  # Fully opaque.
    gaussians.log_scales[7, 2] = -np.inf  # Flat.
    write_gaussians(tmp_path / "a.ply", gaussians)
    warnings: list[str] = []
    found = read_gaussians(tmp_path / "a.ply", warnings)
    assert torch.equal(found.means, gaussians.means[[0, 1, 6, 7, 8, 9]])
    assert all(tensor.isfinite().all() for tensor in found.tensors().values())
    assert found.opacity_logits[2].sigmoid() == 1 and found.log_scales[3, 2] < -20
    assert len(warnings) == 1 and "4 of 10" in warnings[0]


def test_nothing_to_render_is_an_error(tmp_path) -> None:
    gaussians = sample(3)
    gaussians.means[:] = np.nan
    write_gaussians(tmp_path / "a.ply", gaussians)
    with pytest.raises(UserError, match="none that can be rendered"):
        read_gaussians(tmp_path / "a.ply", [])


def test_faint_gaussians_and_high_bands_are_left_out() -> None:
    gaussians = sample(100)
    [(means, sh)] = reduce_gaussians(gaussians.as_arrays(), 1, 0.5, False).chunks("means", "sh")
    kept = (gaussians.opacity_logits >= 0).numpy()
    assert np.array_equal(means, gaussians.means[kept])
    assert np.array_equal(sh, gaussians.sh[kept][:, :4])
    assert reduce_gaussians(sample(10, 0).as_arrays(), 3, 0, False).sh_degree == 0
    with pytest.raises(UserError, match="have an opacity below"):
        reduce_gaussians(gaussians.as_arrays(), 3, 1.0, False)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("degree", [0, 3])
def test_files_do_not_depend_on_the_size_of_chunks(tmp_path, monkeypatch, suffix, degree) -> None:
    gaussians = sample(100)
    gaussians.means[50] *= 1e4  # an outlier of SPZ
    gaussians.quats[60] = 0
    whole = reduce_gaussians(gaussians.as_arrays(), degree, 0.1, True)
    write_gaussians(tmp_path / f"whole{suffix}", whole)
    monkeypatch.setattr(arrays, "CHUNK", 7)
    write_gaussians(tmp_path / f"chunks{suffix}", whole)
    assert (tmp_path / f"chunks{suffix}").read_bytes() == (tmp_path / f"whole{suffix}").read_bytes()


def test_gaussians_are_scaled_in_chunks(monkeypatch) -> None:
    gaussians = sample(50).as_arrays()
    monkeypatch.setattr(arrays, "CHUNK", 7)
    found = gaussians.scaled(3.7)
    assert np.array_equal(found.means, np.float32(gaussians.means.astype(np.float64) * 3.7))
    log_scales = gaussians.log_scales.astype(np.float64) + math.log(3.7)
    assert np.array_equal(found.log_scales, np.float32(log_scales))
    assert found.sh is gaussians.sh and gaussians.scaled(1) is gaussians


def test_formats_are_written_without_torch() -> None:
    code = "import pipeline.export.write, sys; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_morton_order_is_a_permutation_with_neighbours_close_together() -> None:
    gaussians = sample(4000, 0)
    found = in_morton_order(gaussians)
    assert sorted(map(tuple, found.means.tolist())) == sorted(map(tuple, gaussians.means.tolist()))

    def step(means: torch.Tensor) -> float:
        return float((means[1:] - means[:-1]).norm(dim=1).median())

    assert step(found.means) < 0.3 * step(gaussians.means)
    # Rows stay together.
    row = int((gaussians.means == found.means[17]).all(1).nonzero())
    for name, tensor in found.tensors().items():
        assert torch.equal(tensor[17], gaussians.tensors()[name][row])


def test_morton_order_follows_the_curve() -> None:
    corners = [[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    gaussians = sample(8, 0)
    gaussians.means[:] = torch.tensor(corners).float().flip(0)
    assert in_morton_order(gaussians).means.tolist() == corners
    assert len(in_morton_order(sample(0))) == 0 and len(in_morton_order(sample(1))) == 1
