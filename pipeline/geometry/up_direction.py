"""The direction that a scene's cameras together hold up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

# How much columns of pictures count beside their rows, where up is sought.
COLUMN_WEIGHT = 0.02


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
