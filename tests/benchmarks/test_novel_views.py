"""Two models of the same photographs are compared from the same places, whatever their worlds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.novel_views import Finished, _alignment, _moved
from pipeline.coverage.probe_views import project
from pipeline.geometry.rotations import quat_to_rotation
from pipeline.geometry.similarity import Similarity
from pipeline.render import RasterOptions
from pipeline.runtime.errors import UserError
from pipeline.scene.views import View
from tests.coverage.scenes import UP, camera, wall

WORLD = Similarity(2.5, quat_to_rotation(np.array([0.3, -0.7, 0.5, 0.2])), np.array([3.0, -2, 9]))


def finished(name: str, views: list[View]) -> Finished:
    return Finished(Path(name), wall(), views, UP, RasterOptions())


def test_another_world_shows_the_same() -> None:
    """Also with cameras in a row, whose centres leave the rotation open."""
    views = [camera(f"{i}.png", (0.3 * i, 0, 0), (0.1 * i, 0.2, 4)) for i in range(4)]
    other = [_moved(view, WORLD) for view in reversed(views)]
    found = _alignment(finished("a", views), finished("b", other))
    points = wall().means.numpy().astype(float)
    np.testing.assert_allclose(found(points), WORLD(points), atol=1e-6)
    for view in views:
        pixels = project(view, points + 0.01)[1]
        assert len(pixels) > 100
        np.testing.assert_array_equal(project(_moved(view, found), found(points + 0.01))[1], pixels)


def test_a_model_of_other_photographs_is_refused() -> None:
    views = [camera(f"{i}.png", (0.3 * i, 0, 0)) for i in range(4)]
    renamed = [replace(view, name=f"other/{view.name}") for view in views]
    with pytest.raises(UserError, match="found 0 with equal names"):
        _alignment(finished("a", views), finished("b", renamed))
