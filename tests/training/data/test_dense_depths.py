"""Dense depth maps become known depths: at pixel centres, where a depth is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.mvs.maps import DenseMap, write_map
from pipeline.runtime.errors import UserError
from pipeline.scene.views import View
from pipeline.training.data import dense_depths
from pipeline.training.data.dense_depths import add_dense_depths
from pipeline.training.data.known_depths import KnownDepths
from tests.training.conftest import camera_at

NONE = KnownDepths(np.zeros((0, 2)), np.zeros(0, np.float32), np.zeros(0, np.float32))
ONE = KnownDepths(np.full((1, 2), 7.5), np.full(1, 4.0, np.float32), np.ones(1, np.float32))


@pytest.fixture
def view(tmp_path: Path) -> View:
    """A view whose map has no depth on the left, then a ramp of depth and confidence."""
    view = replace(camera_at(0.0), name="a.png")
    column = np.arange(view.width, dtype=np.float32)[None].repeat(view.height, 0)
    depth = np.where(column < 10, 0, 2 + column / 10).astype(np.float32)
    normals = np.zeros((view.height, view.width, 3), np.float32)
    normals[..., 2] = -1
    write_map(tmp_path, view.name, DenseMap(depth, normals, (depth > 0) * column / 50))
    return view


def test_depths_and_confidences_are_those_of_their_pixels(view: View, tmp_path: Path) -> None:
    (found,) = add_dense_depths([view], [NONE], tmp_path)
    assert len(found) == (view.width - 10) * view.height  # every pixel of a small view
    column = found.xy[:, 0] - 0.5
    assert column.min() == 10 and (column == column.astype(int)).all()
    np.testing.assert_allclose(found.z, 2 + column / 10, rtol=2e-4)
    np.testing.assert_allclose(found.weight, column / 50, atol=1 / 255)


def test_large_maps_are_sampled_evenly_and_sparse_points_stay(
    view: View, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dense_depths, "SAMPLES", view.width * view.height / 16)
    (found,) = add_dense_depths([view], [ONE], tmp_path)
    assert found.z[0] == 4.0 and found.xy[0].tolist() == [7.5, 7.5]
    xy = found.xy[1:] - 0.5
    assert len(np.unique(xy, axis=0)) == len(xy) == 8 * 8
    assert np.unique(np.diff(np.unique(xy[:, 0]))) == np.unique(np.diff(np.unique(xy[:, 1]))) == 4


def test_a_missing_map_is_an_error(view: View, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="found none"):
        add_dense_depths([replace(view, name="b.png")], [NONE], tmp_path)
