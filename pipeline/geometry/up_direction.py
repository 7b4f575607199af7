"""Estimation of a scene's up direction from its cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Contradiction = Literal["upside down", "on their side"]

# Weight of the images' columns relative to their rows.
COLUMN_WEIGHT = 0.02
# Below this length of their mean, the columns of the images cancel; above it, the viewing
# directions agree: strips of a flight in both directions with a camera that looks down.
CANCEL, AGREE = 0.5, 0.8
# The tops of images contradict an up direction at more than 60 degrees, or at more than 120. Images
# of cameras that look up or down by more than 45 degrees may have any heading, and show nothing.
TILTED_COS, LEVEL_SIN = 0.5, 0.7
# If fewer cameras are level than this share, the viewing directions decide: cameras do not look up
# by more than 30 degrees on average, because the sky has no features.
LEVEL_SHARE, LOOKS_UP = 0.34, 0.5


@dataclass(frozen=True)
class ImageDirections:
    """Directions of photographs in the world, unit vectors (N, 3).

    Attributes:
        top: The direction from the centre to the top of the upright image.
        right: The direction from the centre to the right of the upright image.
        ahead: The direction along the optical axis.
    """

    top: Array
    right: Array
    ahead: Array

    def contradiction(self, up: Array) -> Contradiction | None:
        """How an up direction contradicts the photographs, None where it does not.

        Args:
            up: (3,) unit vector.
        """
        looking = self.ahead @ up
        level = np.abs(looking) <= LEVEL_SIN
        if level.mean() < LEVEL_SHARE:
            return "upside down" if float(looking.mean()) > LOOKS_UP else None
        upward, across = self.top[level] @ up, self.right[level] @ up
        cosine = float(upward.mean() / np.hypot(upward, across).mean())
        if cosine < -TILTED_COS:
            return "upside down"
        return "on their side" if cosine < TILTED_COS else None


def image_directions(rotations: Array, orientations: Sequence[int]) -> ImageDirections:
    """Directions of photographs.

    Args:
        rotations: (N, 3, 3) world to camera.
        orientations: N EXIF orientations, 1 to 8. Poses refer to the stored pixels, so the rows
            and columns of the upright image follow from the orientation.
    """
    # Direction of the upright image's top on the sensor. Source: EXIF 2.3, tag Orientation.
    tops = {3: (0, 1), 4: (0, 1), 5: (-1, 0), 6: (-1, 0), 7: (1, 0), 8: (1, 0)}
    signs = np.array([tops.get(orientation, (0, -1)) for orientation in orientations], np.float64)
    signs = signs.reshape(-1, 2)
    top = signs[:, :1] * rotations[:, 0] + signs[:, 1:] * rotations[:, 1]
    ahead = rotations[:, 2]
    return ImageDirections(top, np.cross(ahead, top), ahead)


def up_direction(rotations: Array, orientations: Sequence[int]) -> Array:
    """The scene's up direction as a (3,) unit vector in the world.

    Photographers tilt cameras but rarely roll them, so up is the direction most perpendicular to
    the rows of all images. If the rows do not determine it (all cameras have the same heading), the
    mean direction of the images' columns does. Where the columns cancel and all cameras look in the
    same direction, they look down.

    Args:
        rotations, orientations: The arguments of ``image_directions``.

    Returns:
        (3,). (0, -1, 0) if there are no cameras or their directions cancel: COLMAP's y axis
        points down.
    """
    directions = image_directions(np.reshape(rotations, (-1, 3, 3)), orientations)
    count = max(len(directions.top), 1)
    total, ahead = directions.top.sum(0), directions.ahead.sum(0)
    rows = np.zeros((3, 3))
    for row in directions.right:
        rows += np.outer(row, row) / count
    length = float(np.linalg.norm(total))
    # The sign: cameras that look straight down are above the scene.
    upwards = total - 0.5 * ahead
    if length < 1e-6 or np.linalg.norm(upwards) < 1e-6:
        return np.array([0.0, -1.0, 0.0])
    mean = total / length
    if length < CANCEL * count and np.linalg.norm(ahead) > AGREE * count:
        mean = -ahead / np.linalg.norm(ahead)
    _, axes = np.linalg.eigh(rows + COLUMN_WEIGHT * (np.eye(3) - np.outer(mean, mean)))
    return np.asarray(axes[:, 0] * np.sign(axes[:, 0] @ upwards))
