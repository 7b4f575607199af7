"""Cameras, posed images and sparse points: COLMAP's reconstruction.

All code uses COLMAP's convention: world to camera, x right, y down, z forward, pixel centres at
half integers. ``pipeline.io`` converts other conventions when it reads and writes files.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera


@dataclass(frozen=True)
class PosedImage:
    """An image with its pose.

    Attributes:
        name: The file name relative to the image folder, with "/" between folders.
        camera_id: The key into ``Reconstruction.cameras``.
        rotation: (3, 3) float64, world to camera.
        translation: (3,) float64, world to camera, in world units.
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
        track_start: (P + 1,) int64; point p is observed in the images
            ``track_image_id[track_start[p]:track_start[p + 1]]``.
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
    def without_tracks(xyz: NDArray[np.float64], rgb: NDArray[np.uint8]) -> Points:
        """Points of unknown error, without observations."""
        count = len(xyz)
        return Points(
            xyz,
            rgb,
            np.full(count, -1.0),
            np.zeros(count + 1, np.int64),
            np.zeros(0, np.int64),
            np.zeros((0, 2)),
        )

    @staticmethod
    def empty() -> Points:
        return Points.without_tracks(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def track_length(self) -> NDArray[np.int64]:
        """(P,) number of images that see each point."""
        return np.diff(self.track_start)


@dataclass(frozen=True)
class Reconstruction:
    """A sparse model.

    Attributes:
        cameras: COLMAP's camera id -> intrinsics.
        images: COLMAP's image id -> image.
    """

    cameras: dict[int, Camera]
    images: dict[int, PosedImage]
    points: Points = field(default_factory=Points.empty)

    def by_name(self) -> dict[str, PosedImage]:
        return {image.name: image for image in self.images.values()}

    def observed_points(self, names: Iterable[str]) -> list[NDArray[np.intp]]:
        """For each named image, the index of the point of each of its observations, ascending."""
        points = self.points
        owner = np.repeat(np.arange(len(points)), points.track_length)
        order = np.argsort(points.track_image_id, kind="stable")
        ids = points.track_image_id[order]
        image_ids = {image.name: image_id for image_id, image in self.images.items()}
        found = []
        for name in names:
            image_id = image_ids[name]
            first, last = np.searchsorted(ids, [image_id, image_id + 1])
            found.append(owner[order[first:last]])
        return found


def with_poses(model: Reconstruction, poses: Mapping[str, NDArray[np.float64]]) -> Reconstruction:
    """A copy of ``model`` with the poses of some images replaced.

    Args:
        poses: The (4, 4) world to camera by image name.
    """

    def updated(image: PosedImage) -> PosedImage:
        pose = poses.get(image.name, image.world_to_camera)
        return replace(image, rotation=pose[:3, :3], translation=pose[:3, 3])

    return replace(model, images={key: updated(image) for key, image in model.images.items()})
