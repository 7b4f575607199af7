"""A skybox hides the background in all directions, in the colours of the nearest points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config.schema import Init
from pipeline.render import RasterOptions, make_backend
from pipeline.render.views import raster_camera
from pipeline.runtime.errors import UserError
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.init import InitGaussians, gaussians_from_points
from pipeline.splats.skybox import NUM_GAUSSIANS, RADIUS, Sky, fibonacci_sphere, with_skybox
from tests.splats.test_init import CENTRES, assert_valid, coordinate, looking_at, points_at

RED, BLUE = (255, 0, 0), (0, 0, 255)


def scene(count: int = 300) -> InitGaussians:
    """Red points at x > 0, blue ones elsewhere."""
    xyz = np.random.default_rng(0).normal(size=(count, 3))
    points = points_at(xyz)
    points.rgb[:] = np.where(xyz[:, :1] > 0, RED, BLUE)
    return gaussians_from_points(points, CENTRES, Init(), 0)


def sky(gaussians: InitGaussians) -> Gaussians:
    arrays = with_skybox(gaussians, CENTRES, trained=False).arrays()
    return Gaussians(**{k: torch.from_numpy(v[len(gaussians) :]) for k, v in arrays.items()})


@pytest.mark.parametrize("target", [*np.eye(3), *-np.eye(3)], ids=str)
def test_it_hides_the_background_in_all_directions(target: np.ndarray) -> None:
    view = looking_at(CENTRES.mean(0), CENTRES.mean(0) + target)
    rendered = make_backend().forward(
        *sky(scene()).parameters(), raster_camera(view), RasterOptions(sh_degree=0, threads=1)
    )
    assert rendered.alpha.min() > 0.9


def test_it_has_the_colours_of_the_points_in_its_direction() -> None:
    added = sky(scene())
    directions = fibonacci_sphere(NUM_GAUSSIANS)
    red, blue = added.sh[:, 0, 0].numpy(), added.sh[:, 0, 2].numpy()
    # The points are around the origin, which is ahead of the cameras at z = -5.
    right = directions[:, 0] > 0.3
    left = directions[:, 0] < -0.3
    assert (red[right] > blue[right]).all() and (red[left] < blue[left]).all()


def test_it_is_behind_the_scene_and_leaves_its_gaussians_as_they_were() -> None:
    before = scene()
    after = with_skybox(before, CENTRES)
    assert len(after) == len(before) + 2 * NUM_GAUSSIANS
    for name, array in before.arrays().items():
        assert np.array_equal(after.arrays()[name][: len(before)], array)
    distance = np.linalg.norm(after.means - CENTRES.mean(0), axis=1)
    near, far = distance[: len(before)], distance[len(before) :]
    assert far.min() > RADIUS / 3 * near.max()
    assert (after.num_dropped, after.num_thinned) == (before.num_dropped, before.num_thinned)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=20))
def test_it_is_finite_for_any_points(rows: list) -> None:
    try:
        gaussians = gaussians_from_points(points_at(np.array(rows)), CENTRES, Init(), 0)
    except UserError:
        return
    assert_valid(with_skybox(gaussians, CENTRES))


def test_cameras_and_points_in_one_place_do_not_make_it_infinite() -> None:
    gaussians = replace(scene(), means=np.zeros((300, 3), np.float32))
    assert_valid(with_skybox(gaussians, np.zeros((2, 3))))


def test_the_sky_is_the_skybox_and_nothing_else() -> None:
    gaussians = with_skybox(scene(), CENTRES)
    gaussians.means[3] = np.nan
    expected = np.arange(len(gaussians)) >= len(gaussians) - 2 * NUM_GAUSSIANS
    weights = np.where(expected, 0.1, 1.0)
    assert np.array_equal(Sky(CENTRES).contains(gaussians.means, weights), expected)
    assert Sky(CENTRES).contains(gaussians.means[:0]).shape == (0,)
    many = with_skybox(scene(1200), CENTRES).means
    assert np.array_equal(Sky(CENTRES).contains(many), np.arange(len(many)) >= 1200)
