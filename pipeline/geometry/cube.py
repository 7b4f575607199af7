"""The faces of a cube around a camera, into which wide photographs are split."""

from __future__ import annotations

import numpy as np

OVERLAP_DEGREES = 5.0
# Tangent of half the field of view of a face.
REACH = float(np.tan(np.radians(45 + OVERLAP_DEGREES / 2)))

# Camera to face: rows are the face's axes (right, down, forward) in the camera's frame.
ROTATIONS: dict[str, tuple[tuple[int, int, int], ...]] = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
}


def panorama_face_side(width: int) -> int:
    """The side of a face in pixels at the angular resolution of the centre of a panorama of
    ``width`` pixels."""
    return 2 * int(np.ceil(REACH * width / (2 * np.pi)))
