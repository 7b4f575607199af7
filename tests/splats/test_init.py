"""Initial Gaussians: finite for any points; positions, scales and rotations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config.experiments import InitExperiments
from pipeline.config.schema import Init
from pipeline.geometry.rotations import quat_to_rotation
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import Points
from pipeline.scene.views import View
from pipeline.splats.init import (
    FLATNESS,
    MAX_ANGLE,
    SH_C0,
    InitGaussians,
    gaussians_from_points,
    gaussians_random,
)

CENTRES = np.array([[0.0, 0.0, -5.0], [1.0, 0.0, -5.0], [0.0, 1.0, -5.0]])


def points_at(xyz: np.ndarray) -> Points:
    n = len(xyz)
    return Points(
        xyz=np.asarray(xyz, np.float64).reshape(n, 3),
        rgb=np.full((n, 3), 200, np.uint8),
        error=np.zeros(n),
        track_start=np.zeros(n + 1, np.int64),
        track_image_id=np.zeros(0, np.int64),
        track_xy=np.zeros((0, 2)),
    )


def looking_at(centre: np.ndarray, target: np.ndarray) -> View:
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.1, 1.0, 0.05])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    return View("v", "v.png", None, 80, 60, 70.0, 70.0, 40.0, 30.0, pose, False)


def assert_valid(gaussians: InitGaussians) -> None:
    n = len(gaussians)
    for array in gaussians.arrays().values():
        assert array.dtype == np.float32
        assert array.flags.c_contiguous
        assert len(array) == n
        assert np.isfinite(array).all()
    assert np.isfinite(np.exp(gaussians.log_scales)).all()
    assert (np.exp(gaussians.log_scales) > 0).all()


coordinate = st.one_of(
    st.floats(-10, 10),
    st.sampled_from([0.0, 1.0, -5.0, 1e-30, 1e12, -1e17]),
    st.floats(allow_nan=True, allow_infinity=True),
)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=40))
def test_any_points_give_finite_gaussians_or_a_user_error(rows: list) -> None:
    try:
        result = gaussians_from_points(points_at(np.array(rows)), CENTRES, Init(), 1)
    except UserError:
        return
    assert_valid(result)
    assert len(result) + result.num_dropped == len(rows)


def test_duplicates_and_a_single_point_have_a_positive_scale() -> None:
    for xyz in (np.zeros((1, 3)), np.zeros((20, 3))):
        result = gaussians_from_points(points_at(xyz), CENTRES, Init(), 0)
        assert_valid(result)
        assert np.exp(result.log_scales).min() > 1e-5


def test_scale_is_the_mean_distance_of_three_neighbours() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(4) * 0.1] * 3), -1).reshape(-1, 3)
    result = gaussians_from_points(points_at(grid), CENTRES, Init(), 0)
    assert np.allclose(np.exp(result.log_scales), 0.1, rtol=1e-5)
    assert np.allclose(0.5 + SH_C0 * result.sh[:, 0], 200 / 255, atol=1e-6)
    assert np.allclose(
        1 / (1 + np.exp(-result.opacity_logits)), InitExperiments().opacity, atol=1e-6
    )


def test_points_next_to_a_camera_and_far_outliers_are_dropped() -> None:
    good = np.random.default_rng(0).normal(size=(200, 3))
    bad = np.array([[0.0, 0.0, -5.0], [0.0, 0.001, -5.0], [0.0, 0.0, 1e7]])
    result = gaussians_from_points(points_at(np.concatenate([good, bad])), CENTRES, Init(), 0)
    assert result.num_dropped == 3
    assert np.allclose(result.means, good.astype(np.float32))


def test_the_scale_of_an_isolated_point_is_limited() -> None:
    cluster = np.random.default_rng(0).normal(size=(100, 3)) * 0.01
    isolated = np.array([[40.0, 0.0, 0.0]])
    points = points_at(np.concatenate([cluster, isolated]))
    result = gaussians_from_points(points, CENTRES, Init(), 0)
    distance = np.linalg.norm(isolated - CENTRES, axis=1).min()
    assert np.exp(result.log_scales[-1, 0]) <= MAX_ANGLE * distance * 1.0001


def test_thinning_keeps_max_points_and_is_deterministic() -> None:
    xyz = np.random.default_rng(0).normal(size=(500, 3))
    first = gaussians_from_points(points_at(xyz), CENTRES, Init(max_points=50), 0)
    again = gaussians_from_points(points_at(xyz), CENTRES, Init(max_points=50), 0)
    assert len(first) == 50
    assert first.num_thinned == 450
    assert np.array_equal(first.means, again.means)


def test_first_axes_are_surface_normals_in_any_world_frame() -> None:
    rng = np.random.default_rng(2)
    wall = np.column_stack([rng.uniform(-1, 1, (200, 2)), 0.01 * rng.normal(size=200)])
    other = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    other *= np.sign(np.linalg.det(other))
    normals = []
    for rotation in (np.eye(3), other):
        result = gaussians_from_points(points_at(wall @ rotation.T), CENTRES, Init(), 0)
        axes = quat_to_rotation(result.quats.astype(np.float64))
        assert np.allclose(np.linalg.det(axes), 1.0)
        normals.append(axes[:, :, 0])
    cosine = np.abs(np.einsum("ni,ni->n", normals[0] @ other.T, normals[1]))
    assert np.allclose(cosine, 1.0, atol=1e-6)
    assert np.median(np.abs(normals[0][:, 2])) > 0.99


def test_no_usable_point_is_a_user_error() -> None:
    with pytest.raises(UserError, match="none is usable"):
        gaussians_from_points(points_at(np.full((3, 3), np.nan)), CENTRES, Init(), 0)
    with pytest.raises(UserError, match="none is usable"):
        gaussians_from_points(Points.empty(), CENTRES, Init(), 0)


def test_random_gaussians_of_inward_facing_cameras() -> None:
    target = np.array([3.0, -2.0, 7.0])
    directions = np.random.default_rng(0).normal(size=(12, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    views = [looking_at(target + 4.0 * d, target) for d in directions]
    result = gaussians_random(views, 2, 1, InitExperiments(num_random=500))
    assert_valid(result)
    assert result.sh.shape == (500, 9, 3)
    # Every second Gaussian is in the ball inside all views, the others in the cube.
    inner, others = result.means[::2], result.means[1::2]
    assert np.allclose(inner.mean(0), target, atol=0.3)
    assert np.abs(others - target).max() > 2 * 4.0
    assert (np.abs(others - target) < 4.0).all(1).any()
    assert np.allclose(1 / (1 + np.exp(-result.opacity_logits)), 0.1)
    for view in views:
        camera = inner @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
        pixel = camera[:, :2] / camera[:, 2:] * 70.0 + [40.0, 30.0]
        assert (camera[:, 2] > 0).all()
        assert ((pixel >= -0.5) & (pixel <= [80.5, 60.5])).all()
    other = gaussians_random(views, 2, 2, InitExperiments(num_random=500))
    assert not np.array_equal(result.means, other.means)


def test_random_gaussians_of_forward_facing_cameras_are_in_front_of_them() -> None:
    views = [looking_at(np.array([0.1 * i, 0.0, 0.0]), np.array([0.1 * i, 0, 9])) for i in range(5)]
    result = gaussians_random(views, 0, 1, InitExperiments(num_random=300))
    assert_valid(result)
    assert (result.means[:, 2] > 0).all()


def test_rounding_turns_no_gaussian():
    """The signs of normals do not depend on the last bits, so that a scene in another unit starts
    with the same Gaussians."""
    rng = np.random.default_rng(0)
    sheets = [rng.uniform(-1, 1, (200, 2)) for _ in range(3)]
    xyz = np.concatenate([np.insert(sheet, k, 0.3 * k, axis=1) for k, sheet in enumerate(sheets)])
    first = gaussians_from_points(points_at(xyz), CENTRES, Init(), 0)
    there = gaussians_from_points(points_at(xyz * 1000 * 0.001), CENTRES, Init(), 0)
    np.testing.assert_allclose(there.quats, first.quats, atol=1e-6)


def test_gaussians_are_flat_along_known_normals():
    rng = np.random.default_rng(2)
    xyz = rng.uniform(-1, 1, (50, 3))
    normals = rng.normal(size=(50, 3))
    normals[:3] = np.diag([1.0, 1.0, -1.0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[40:] = np.nan
    found = gaussians_from_points(points_at(xyz), CENTRES, Init(max_points=30), 0, normals=normals)
    assert_valid(found)
    nearest = ((xyz[:, None] - found.means[None]) ** 2).sum(-1).argmin(0)
    known = nearest < 40
    assert 0 < known.sum() < len(found)
    axes = quat_to_rotation(found.quats[known].astype(np.float64))
    np.testing.assert_allclose(axes[:, :, 0], normals[nearest[known]], atol=1e-5)
    thickness = np.exp(found.log_scales[:, 0] - found.log_scales[:, 1])
    np.testing.assert_allclose(thickness, np.where(known, FLATNESS, 1.0), rtol=1e-5)
