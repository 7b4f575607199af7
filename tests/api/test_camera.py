"""Cameras of the Python API: where they look, and what they refuse."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from splatmake import Camera, UserError

UPS = [(0, 0, 1), (0, -2, 0), (1, 1, 0.5)]


def pixel(camera: Camera, point: Any) -> np.ndarray:
    """(2,) where the camera shows a point of the world, pixels; the point is in front of it."""
    x, y, z = camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3]
    assert z > 0
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


@pytest.mark.parametrize("up", UPS)
def test_a_camera_looks_at_its_target_upright(up: tuple[float, float, float]) -> None:
    eye, target = np.array([1.0, 2.0, -3.0]), np.array([0.5, 4.0, 2.0])
    camera = Camera.look_at(eye, target, up=up, width=400, height=300, fov=90)
    assert np.linalg.det(camera.world_to_camera[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(camera.centre, eye)
    np.testing.assert_allclose(pixel(camera, target), (200, 150))
    above = pixel(camera, target + 0.1 * np.array(up))
    assert above[0] == pytest.approx(200) and above[1] < 150
    # The right border is at half of the angle of view.
    right = camera.world_to_camera[0, :3]
    distance = float(np.linalg.norm(target - eye))
    assert pixel(camera, target + distance * right)[0] == pytest.approx(400)
    assert camera.fov == pytest.approx(90)


def test_another_size_shows_the_same() -> None:
    camera = Camera.look_at((0, 0, -3), (0, 0, 0), up=(0, 1, 0), width=400, height=300)
    camera = replace(camera, cx=180.0, cy=120.0)
    for large in (camera.resized(800), camera.resized(800, 600)):
        assert (large.width, large.height) == (800, 600)
        assert large.fov == pytest.approx(camera.fov)
        for point in ((0, 0, 0), (0.3, -0.2, 1)):
            np.testing.assert_allclose(pixel(large, point), 2 * pixel(camera, point))


GOOD = {"eye": (0, 0, 0), "target": (0, 0, 1), "up": (0, 1, 0)}


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"target": (0, 0, 0)}, "expected eye and target to differ"),
        ({"up": (0, 0, -2)}, "up: expected a direction across the line of sight"),
        ({"up": (0, 0, 0)}, "up: expected a direction across the line of sight"),
        ({"eye": (0, 0)}, "expected three numbers each"),
        ({"eye": (0, 0, float("nan"))}, "expected three numbers each"),
        ({"fov": 180}, "fov: expected degrees above 0 and below 180, found 180"),
        ({"width": 0}, "found 0x720 pixels"),
        ({"height": 10**9}, "megapixels, found 1280x1000000000 pixels"),
    ],
)
def test_what_is_no_camera_is_one_error(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        Camera.look_at(**(GOOD | wrong))


MIRRORED = np.diag([-1.0, 1.0, 1.0, 1.0])
FAR = np.eye(4)
FAR[0, 3] = np.inf


@pytest.mark.parametrize("pose", [2 * np.eye(4), np.eye(3), np.full((4, 4), np.nan), MIRRORED, FAR])
def test_a_pose_is_a_rotation_and_a_translation(pose: np.ndarray) -> None:
    with pytest.raises(UserError, match="world_to_camera: expected a rotation"):
        Camera(8, 6, 5.0, 5.0, 4.0, 3.0, pose)
