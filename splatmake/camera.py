"""Cameras without photographs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.io.photofile import MAX_PIXELS
from pipeline.runtime.errors import UserError
from pipeline.scene.views import View, resized

Vector = Sequence[float] | NDArray[np.floating]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in COLMAP's and OpenCV's convention: x right, y down, z forward, and the
    centre of the first pixel at (0.5, 0.5).

    ``dataclasses.replace`` changes single values.

    Attributes:
        width, height: The size of the image in pixels.
        fx, fy, cx, cy: The focal lengths and the principal point in pixels.
        world_to_camera: (4, 4) float64. The world is that of the scene's views.

    Raises:
        UserError: The size, a focal length or the pose is impossible.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: NDArray[np.float64]

    def __post_init__(self) -> None:
        pose = np.asarray(self.world_to_camera, np.float64)
        object.__setattr__(self, "world_to_camera", pose)
        size = f"{self.width}x{self.height} pixels"
        if not (self.width > 0 < self.height and self.width * self.height <= MAX_PIXELS):
            what = f"expected a camera of 1 to {MAX_PIXELS >> 20} megapixels, found {size}"
            raise UserError(what, fix="give width and height in pixels")
        numbers = [self.fx, self.fy, self.cx, self.cy]
        if not (np.isfinite(numbers).all() and self.fx > 0 < self.fy):
            what = f"expected focal lengths above 0 and a principal point, found {numbers}"
            raise UserError(what, fix="give fx, fy, cx and cy in pixels")
        if not _is_pose(pose):
            raise UserError(
                f"world_to_camera: expected a rotation and a translation in a 4 x 4 matrix, found "
                f"{pose.tolist()}",
                fix="give a matrix that takes points of the world to the camera's axes (x right, y "
                "down, z forward), as Camera.look_at does",
            )

    def __repr__(self) -> str:
        x, y, z = self.centre
        size = f"{self.width}x{self.height} pixels, {self.fov:.1f} degrees"
        return f"Camera({size}, at {x:.4g}, {y:.4g}, {z:.4g})"

    @property
    def centre(self) -> NDArray[np.float64]:
        """(3,) the position in the world."""
        return np.asarray(-self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3])

    @property
    def fov(self) -> float:
        """The horizontal angle of view in degrees."""
        left, right = self.cx / self.fx, (self.width - self.cx) / self.fx
        return math.degrees(math.atan(left) + math.atan(right))

    @staticmethod
    def of(view: View) -> Camera:
        """The camera of a view."""
        sizes = view.width, view.height, view.fx, view.fy, view.cx, view.cy
        return Camera(*sizes, view.world_to_camera)

    @staticmethod
    def look_at(
        eye: Vector,
        target: Vector,
        *,
        up: Vector,
        width: int = 1280,
        height: int = 720,
        fov: float = 60.0,
    ) -> Camera:
        """A camera at ``eye`` whose centre shows ``target``.

        Args:
            eye, target: (3,) positions in the scene's world.
            up: (3,) the direction in the world that is upwards in the image, of any length.
                ``Scene.up`` keeps the scene upright.
            width, height: The size of the image in pixels.
            fov: The horizontal angle of view in degrees, above 0 and below 180.

        Raises:
            UserError: ``eye`` and ``target`` are the same point, ``up`` points along the line of
                sight, or a value is impossible.
        """
        places = [np.asarray(value, np.float64) for value in (eye, target, up)]
        if any(place.shape != (3,) or not np.isfinite(place).all() for place in places):
            found = ", ".join(str(place.tolist()) for place in places)
            raise UserError(f"eye, target, up: expected three numbers each, found {found}")
        if not 0 < fov < 180:
            raise UserError(f"fov: expected degrees above 0 and below 180, found {fov}")
        position, seen, upwards = places
        forward = _unit(seen - position)
        if forward is None:
            raise UserError(f"expected eye and target to differ, found both at {seen.tolist()}")
        direction = _unit(upwards)
        right = None if direction is None else _unit(np.cross(forward, direction), 1e-6)
        if right is None:
            raise UserError(
                f"up: expected a direction across the line of sight, found {upwards.tolist()}, "
                f"which is along {forward.tolist()}",
                fix="look down or up with another vector as up, such as the heading",
            )
        pose = np.eye(4)
        pose[:3, :3] = right, np.cross(forward, right), forward
        pose[:3, 3] = -pose[:3, :3] @ position
        focal = width / 2 / math.tan(math.radians(fov) / 2)
        return Camera(width, height, focal, focal, width / 2, height / 2, pose)

    def resized(self, width: int, height: int | None = None) -> Camera:
        """The same camera with images of another size, which show the same part of the scene.

        Args:
            width, height: The size in pixels; None for the height that keeps the shape of pixels.
        """
        if height is None:
            height = max(1, round(self.height * width / self.width))
        return Camera.of(resized(self.as_view(), width, height))

    def as_view(self) -> View:
        """A view of this camera, without photograph."""
        sizes = self.width, self.height, self.fx, self.fy, self.cx, self.cy
        return View("", "", None, *sizes, self.world_to_camera, is_test=False)


def _is_pose(matrix: NDArray[np.float64]) -> bool:
    """Whether a matrix is a rotation, which does not mirror, and a translation."""
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        return False
    rotation = matrix[:3, :3]
    is_orthogonal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
    return bool(is_orthogonal and np.linalg.det(rotation) > 0)


def _unit(vector: NDArray[np.float64], least: float = 0.0) -> NDArray[np.float64] | None:
    """The vector at length 1; None if it is not longer than ``least``."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > least else None
