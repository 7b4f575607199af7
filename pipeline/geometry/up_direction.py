"""Estimation of a scene's up direction from its cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

# Weight of the images' columns relative to their rows.
COLUMN_WEIGHT = 0.02


def up_direction(
    rotations: NDArray[np.float64], orientations: Sequence[int]
) -> NDArray[np.float64]:
    """The scene's up direction as a (3,) unit vector in the world.

    Photographers tilt cameras but rarely roll them, so up is the direction most perpendicular to
    the rows of all images. If the rows do not determine it (all cameras have the same heading), the
    mean direction of the images' columns does.

    Args:
        rotations: (N, 3, 3) world to camera.
        orientations: N EXIF orientations, 1 to 8. Poses refer to the stored pixels, so the rows
            and columns of the upright image follow from the orientation.

    Returns:
        (3,). (0, -1, 0) if there are no cameras or their directions cancel: COLMAP's y axis
        points down.
    """
    # Direction of the upright image's top on the sensor. Source: EXIF 2.3, tag Orientation.
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
    # The sign: cameras that look straight down are above the scene.
    upwards = total - 0.5 * ahead
    if length < 1e-6 or np.linalg.norm(upwards) < 1e-6:
        return np.array([0.0, -1.0, 0.0])
    mean = total / length
    _, axes = np.linalg.eigh(rows + COLUMN_WEIGHT * (np.eye(3) - np.outer(mean, mean)))
    return np.asarray(axes[:, 0] * np.sign(axes[:, 0] @ upwards))
