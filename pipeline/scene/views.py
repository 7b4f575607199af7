"""The pinhole views that training and evaluation look at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.config import schema
from pipeline.scene.manifest import Manifest
from pipeline.scene.model import Reconstruction, View, is_held_out

# How much columns of pictures count beside their rows, where up is sought.
COLUMN_WEIGHT = 0.02


def view_size(width: int, height: int, max_long_side: int) -> tuple[int, int]:
    """Width and height in pixels, reduced so that neither exceeds ``max_long_side``; the shape
    stays, but for rounding."""
    longest = max(width, height)
    if longest <= max_long_side:
        return width, height
    return (
        max(1, round(width * max_long_side / longest)),
        max(1, round(height * max_long_side / longest)),
    )


def load_views(
    manifest: Manifest, model: Reconstruction, views: schema.Views, split: schema.Split
) -> list[View]:
    """The photographs that have a pose, sorted by name, at the size ``views`` asks for.

    Intrinsics are scaled by the exact ratios of widths and of heights.

    Raises:
        ValueError: a camera distorts; such pictures must be undistorted first.
    """
    posed = model.by_name()
    photos = sorted((p for p in manifest.photos if p.name in posed), key=lambda photo: photo.name)
    # A single view is trained on: there is nothing to learn from none.
    every = split.holdout_every if len(photos) > 1 else 0
    result = []
    for index, photo in enumerate(photos):
        image = posed[photo.name]
        camera = model.cameras[image.camera_id]
        if not camera.is_pinhole:
            raise ValueError(f"{photo.name}: its {camera.model} camera distorts")
        width, height = view_size(photo.width, photo.height, views.max_long_side_px)
        fx, fy, cx, cy = camera.resized(width, height).pinhole
        result.append(
            View(
                name=photo.name,
                image=photo.path,
                mask=photo.mask if views.masks == "auto" else None,
                width=width,
                height=height,
                fx=fx,
                fy=fy,
                cx=cx,
                cy=cy,
                world_to_camera=image.world_to_camera,
                is_test=is_held_out(index, every),
                camera_id=image.camera_id,
            )
        )
    return result


def up_direction(
    rotations: NDArray[np.float64], orientations: Sequence[int]
) -> NDArray[np.float64]:
    """(3,) unit vector of the world that the cameras together hold up.

    People tilt cameras up and down and roll them little, so up is what is perpendicular to the
    rows of all pictures; as far as these leave it open (a camera that does not turn), what the
    pictures' columns point to on average.

    Args:
        rotations: (N, 3, 3) world to camera.
        orientations: the photographs' EXIF orientations, 1 to 8: a camera held upright has its
            sensor's rows run down the photograph.

    Without cameras, or where they disagree entirely, it is -y: up for a camera at the identity.
    """
    # Where the picture's top is on the sensor. Source: EXIF 2.3, tag Orientation.
    top = {3: (0, 1), 4: (0, 1), 5: (-1, 0), 6: (-1, 0), 7: (1, 0), 8: (1, 0)}
    total, rows, ahead = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    for rotation, orientation in zip(rotations, orientations, strict=True):
        right, down = top.get(orientation, (0, -1))
        column = right * rotation[0] + down * rotation[1]
        row = np.cross(column, rotation[2])
        total += column
        rows += np.outer(row, row) / len(rotations)
        ahead += rotation[2]
    length = float(np.linalg.norm(total))
    # Cameras that look straight down hold nothing up, but from above.
    upwards = total - 0.5 * ahead
    if length < 1e-6 or np.linalg.norm(upwards) < 1e-6:
        return np.array([0.0, -1.0, 0.0])
    mean = total / length
    _, axes = np.linalg.eigh(rows + COLUMN_WEIGHT * (np.eye(3) - np.outer(mean, mean)))
    return np.asarray(axes[:, 0] * np.sign(axes[:, 0] @ upwards))


def scene_extent(views: list[View]) -> float:
    """1.1 times the largest distance of a training camera from their mean, in world units.

    3DGS's measure of a scene's size (Kerbl et al. 2023, reference code), by which learning rates
    and thresholds scale. Where the training cameras stand in one place all views count, and
    where these do too the extent is 1.
    """
    for chosen in ([view for view in views if not view.is_test], views):
        if chosen:
            centres = np.stack([view.centre for view in chosen])
            radius = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
            # What is left of a distance by the rounding of poses is none.
            if radius > 1e-9 * float(np.abs(centres).max()):
                return 1.1 * radius
    return 1.0


def scene_up(views: Sequence[View], manifest: Manifest) -> NDArray[np.float64]:
    """(3,) ``up_direction`` of these views' cameras as their photographs were held."""
    orientation = {photo.name: photo.orientation for photo in manifest.photos}
    rotations = np.stack([view.world_to_camera[:3, :3] for view in views])
    return up_direction(rotations, [orientation[view.name] for view in views])
