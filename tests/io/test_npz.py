"""The .npz files of Gaussians that stages exchange."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.io.npz import read_npz, write_npz
from pipeline.runtime.errors import UserError
from tests.splats.samples import sample


def test_gaussians_are_written_and_read_exactly(tmp_path: Path) -> None:
    gaussians = sample(20, 2)
    write_npz(tmp_path / "a.npz", gaussians)
    back = read_npz(tmp_path / "a.npz").tensors()
    assert all(torch.equal(tensor, back[name]) for name, tensor in gaussians.tensors().items())


def test_the_file_is_the_one_that_numpy_writes(tmp_path: Path) -> None:
    gaussians = sample(20, 2)
    write_npz(tmp_path / "a.npz", gaussians)
    np.savez(tmp_path / "b.npz", **gaussians.arrays())
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_a_damaged_file_is_an_error_that_names_it(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", sample(20))
    (tmp_path / "a.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:-100])
    with pytest.raises(UserError, match="could not read") as error:
        read_npz(tmp_path / "a.npz")
    assert str(error.value.file).endswith("a.npz")
