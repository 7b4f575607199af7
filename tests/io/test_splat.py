""".splat files: layout, quantisation errors, and errors on other files."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.io.splat import read_splat, write_splat
from pipeline.runtime.errors import UserError
from tests.splats.samples import Within, sample

C0 = 0.28209479177387814
#: What docs/reference/formats.md states, for colours within [0, 1].
OURS = Within(0, 1e-6, 0.5001 / 255, 0.91, 0.5001 / 255 / C0, 0)


@pytest.mark.parametrize("count", [0, 1, 300])
def test_round_trip_stays_within_the_stated_quantisation(tmp_path, count) -> None:
    gaussians = sample(count)
    write_splat(tmp_path / "a.splat", gaussians)
    OURS.check(read_splat(tmp_path / "a.splat"), gaussians.with_sh_degree(0))


def test_layout_is_that_of_antimatter15_splat(tmp_path) -> None:
    gaussians = sample(2)
    gaussians.quats[1] = gaussians.quats.new_tensor([2.0, 0, 0, 0])
    gaussians.sh[1, 0] = gaussians.sh.new_tensor([-9.0, 0, 9])
    gaussians.opacity_logits[1] = 0.0
    write_splat(tmp_path / "a.splat", gaussians)
    data = (tmp_path / "a.splat").read_bytes()
    assert len(data) == 64
    row = data[32:]
    np.testing.assert_array_equal(np.frombuffer(row[:12], "<f4"), gaussians.means[1])
    np.testing.assert_allclose(np.frombuffer(row[12:24], "<f4"), gaussians.log_scales[1].exp())
    assert [*row[24:]] == [0, 128, 255, 128, 255, 128, 128, 128]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data[:-1], "multiple of 32 bytes"),
        (lambda data: b"\xff" * 32 + data, "impossible"),
        (lambda data: data[:12] + np.float32(-1).tobytes() + data[16:], "impossible"),
    ],
)
def test_other_bytes_are_an_error(tmp_path, change, message) -> None:
    path = tmp_path / "a.splat"
    write_splat(path, sample(2))
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(UserError, match=message) as caught:
        read_splat(path)
    assert caught.value.file == path


@settings(max_examples=60, derandomize=True, deadline=None)
@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_read_or_user_errors(tmp_path_factory, data) -> None:
    path = tmp_path_factory.mktemp("splat") / "a.splat"
    path.write_bytes(data)
    try:
        assert len(read_splat(path)) == len(data) / 32
    except UserError as error:
        assert error.file == path
