"""Cameras, posed images and points, as plain values: what COLMAP calls a reconstruction.

One convention everywhere (COLMAP's): world to camera, x right, y down, z forward, pixel
centres at half integers. Other conventions are converted where files are read and written.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

# COLMAP's camera models: name -> (id in binary files, names of the parameters in order).
# Source: COLMAP's documentation, "Camera Models".
CAMERA_MODELS: dict[str, tuple[int, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (0, ("f", "cx", "cy")),
    "PINHOLE": (1, ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": (2, ("f", "cx", "cy", "k")),
    "RADIAL": (3, ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": (4, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": (5, ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    "FULL_OPENCV": (
        6,
        ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    ),
    "SIMPLE_RADIAL_FISHEYE": (8, ("f", "cx", "cy", "k")),
    "RADIAL_FISHEYE": (9, ("f", "cx", "cy", "k1", "k2")),
}


@dataclass(frozen=True)
class Camera:
    """One camera's intrinsics.

    Attributes:
        model: a name in ``CAMERA_MODELS``.
        width, height: pixels.
        params: float64, in the model's order; focal lengths and principal point in pixels.
    """

    model: str
    width: int
    height: int
    params: NDArray[np.float64]

    @property
    def is_pinhole(self) -> bool:
        """True for a perspective camera without any distortion term."""
        if self.model in ("SIMPLE_PINHOLE", "PINHOLE"):
            return True
        distortion = self.params[len(self.intrinsics_names) :]
        return "FISHEYE" not in self.model and not np.any(distortion)

    @property
    def intrinsics_names(self) -> tuple[str, ...]:
        names = CAMERA_MODELS[self.model][1]
        return names[:3] if names[0] == "f" else names[:4]

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy) in pixels."""
        p = [float(v) for v in self.params]
        if self.intrinsics_names[0] == "f":
            return p[0], p[0], p[1], p[2]
        return p[0], p[1], p[2], p[3]

    def resized(self, width: int, height: int) -> Camera:
        """The same camera for its image resized to ``width`` x ``height`` pixels."""
        sx, sy = width / self.width, height / self.height
        fx, fy, cx, cy = self.pinhole
        rest = self.params[len(self.intrinsics_names) :]
        if self.intrinsics_names[0] == "f" and abs(sx - sy) < 1e-9 * sx:
            params = np.array([fx * sx, cx * sx, cy * sy, *rest])
            return Camera(self.model, width, height, params)
        model = {"SIMPLE_PINHOLE": "PINHOLE", "SIMPLE_RADIAL": "OPENCV", "RADIAL": "OPENCV"}.get(
            self.model, self.model
        )
        if model == "OPENCV" and len(rest) < 4:
            rest = np.concatenate([rest, np.zeros(4 - len(rest))])
        if self.model.endswith("RADIAL_FISHEYE"):
            model, rest = "OPENCV_FISHEYE", np.concatenate([rest, np.zeros(4 - len(rest))])
        return Camera(model, width, height, np.array([fx * sx, fy * sy, cx * sx, cy * sy, *rest]))


@dataclass(frozen=True)
class Posed:
    """One image with its pose.

    Attributes:
        name: file name relative to the image folder, with "/" between folders.
        camera_id: key into ``Reconstruction.cameras``.
        rotation: (3, 3) float64, world to camera.
        translation: (3,) float64, world to camera, in the world's unit.
    """

    name: str
    camera_id: int
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    @property
    def centre(self) -> NDArray[np.float64]:
        """(3,) the camera's centre in the world."""
        return -self.rotation.T @ self.translation

    @property
    def world_to_camera(self) -> NDArray[np.float64]:
        """(4, 4) float64."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation
        return matrix


@dataclass(frozen=True)
class Points:
    """Sparse points, structure of arrays.

    Attributes:
        xyz: (P, 3) float64, world.
        rgb: (P, 3) uint8.
        error: (P,) float64, mean reprojection error in pixels; -1 where unknown.
        track_start: (P + 1,) int64; point p is seen in ``track_image_id[start[p]:start[p + 1]]``.
        track_image_id: (M,) int64, keys into ``Reconstruction.images``.
        track_xy: (M, 2) float64 pixels of the observations, NaN where unknown.
    """

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    error: NDArray[np.float64]
    track_start: NDArray[np.int64]
    track_image_id: NDArray[np.int64]
    track_xy: NDArray[np.float64]

    @staticmethod
    def empty() -> Points:
        return Points(
            np.zeros((0, 3)),
            np.zeros((0, 3), np.uint8),
            np.zeros(0),
            np.zeros(1, np.int64),
            np.zeros(0, np.int64),
            np.zeros((0, 2)),
        )

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def track_length(self) -> NDArray[np.int64]:
        """(P,) number of images that see each point."""
        return np.diff(self.track_start)


@dataclass(frozen=True)
class Reconstruction:
    """Cameras and images by COLMAP id, and points."""

    cameras: dict[int, Camera]
    images: dict[int, Posed]
    points: Points = field(default_factory=Points.empty)

    def by_name(self) -> dict[str, Posed]:
        return {image.name: image for image in self.images.values()}


def with_poses(model: Reconstruction, poses: Mapping[str, NDArray[np.float64]]) -> Reconstruction:
    """The model with other poses, (4, 4) world to camera by name; those not named stay."""

    def moved(image: Posed) -> Posed:
        pose = poses.get(image.name, image.world_to_camera)
        return replace(image, rotation=pose[:3, :3], translation=pose[:3, 3])

    return replace(model, images={key: moved(image) for key, image in model.images.items()})


@dataclass(frozen=True)
class View:
    """A pinhole view ready for training or evaluation.

    Attributes:
        name: the photograph's name.
        image, mask: files; the mask's non-zero pixels count; None where there is none.
        width, height: pixels of the target resolution (the file may be larger).
        fx, fy, cx, cy: pixels, at the target resolution.
        world_to_camera: (4, 4) float64.
        is_test: held out.
        camera_id: key into ``Reconstruction.cameras``; views of one camera share its lens.
    """

    name: str
    image: str
    mask: str | None
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: NDArray[np.float64]
    is_test: bool
    camera_id: int = 0

    @property
    def centre(self) -> NDArray[np.float64]:
        """(3,) the camera's centre in the world."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]


def is_held_out(index: int, every: int) -> bool:
    """The field's split (Mip-NeRF360): of the views sorted by name, each ``every``-th from the
    first is held out; 0 holds out none."""
    return every > 0 and index % every == 0
