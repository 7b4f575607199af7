"""The camera path is smooth and near the photographs, for all kinds of captures."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.surface.path import FRAMES, camera_path, describe_path
from tests.surface.scenes import view_at

UP = np.array([0.0, 0.0, 1.0])


def ring(degrees, radius=3.0, height=1.0, count=24):
    angles = np.radians(np.linspace(0, degrees, count, endpoint=degrees < 360))
    return [view_at((radius * np.cos(a), radius * np.sin(a), height), (0, 0, 0.2)) for a in angles]


def centres(path):
    return np.stack([view.centre for view in path])


def check_smooth(path):
    """Closed, without a jump or a jerk in position or direction, upright."""
    at = centres(path)
    ahead = np.stack([view.world_to_camera[2, :3] for view in path])
    length = np.linalg.norm(np.diff(at, axis=0, append=at[:1]), axis=1)
    assert length.max() < 6 * max(length.mean(), 1e-9)
    assert (np.arccos(np.clip((ahead * np.roll(ahead, -1, 0)).sum(1), -1, 1))).max() < 0.3
    for view in path:
        rotation = view.world_to_camera[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(rotation) > 0
        assert rotation[1] @ UP < 0, "the picture's down points down"


def test_around_a_full_ring():
    path = camera_path(ring(360), 3.0, UP)
    check_smooth(path)
    at = centres(path)
    assert len(path) == FRAMES
    assert np.allclose(np.hypot(at[:, 0], at[:, 1]), 3, atol=0.05)
    assert np.allclose(at[:, 2], 1, atol=0.05)
    angle = np.unwrap(np.arctan2(at[:, 1], at[:, 0]))
    assert abs(angle[-1] - angle[0]) > 2 * np.pi * 0.95


def test_back_and_forth_over_an_arc_and_never_behind_the_subject():
    path = camera_path(ring(120), 3.0, UP)
    check_smooth(path)
    at = centres(path)
    angle = np.degrees(np.arctan2(at[:, 1], at[:, 0]))
    assert angle.min() > 0 and angle.max() < 120
    assert angle.max() - angle.min() > 60


def test_facing_a_wall():
    """Parallel cameras: the focus is on the wall, at the given depth."""
    views = [view_at((-3, y, z), (5, y, z)) for y in (-0.5, 0, 0.5) for z in (-0.2, 0.2)]
    path = camera_path(views, 4.0, UP)
    check_smooth(path)
    at = centres(path)
    assert at[:, 0].max() < -2.5
    assert np.abs(at[:, 1]).max() < 1
    assert np.ptp(at[:, 1]) > 0.2


def test_inside_a_room():
    """Cameras that look outwards are visited in their order."""
    angles = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    views = [
        view_at((0.3 * np.cos(a), 0.3 * np.sin(a), 1), (9 * np.cos(a), 9 * np.sin(a), 1))
        for a in angles
    ]
    path = camera_path(views, 3.0, UP)
    check_smooth(path)
    assert np.linalg.norm(centres(path)[:, :2], axis=1).max() < 0.35


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_views(count):
    path = camera_path(ring(30, count=count), 3.0, UP)
    check_smooth(path)
    assert np.linalg.norm(centres(path) - centres(ring(30, count=count)).mean(0), axis=1).max() < 2


def test_cameras_straight_above():
    path = camera_path([view_at((0.01 * i, 0.02, 3), (0, 0, 0)) for i in range(5)], 3.0, UP)
    for view in path:
        assert np.isfinite(view.world_to_camera).all()


def test_frames_are_half_the_views_and_even():
    path = camera_path(ring(360), 3.0, UP)
    assert (path[0].width, path[0].height) == (48, 48)
    assert np.isclose(path[0].fx / path[0].width, 110 / 96)
    described = describe_path(path)
    assert np.array_equal(described.world_to_camera[7], path[7].world_to_camera)
    assert described.width == 48
