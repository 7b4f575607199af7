"""Camera poses and lenses of the demo scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.scene.reconstruction import PosedImage

Array = NDArray[np.float64]

FOCAL_MM = 28
SENSOR_WIDTH_MM = 36.0
# The largest angle between neighbours at which SIFT still matches: fewer views give a shorter arc.
MAX_STEP_DEGREES = 12.0

LENSES: dict[str, tuple[str, tuple[float, ...]]] = {
    "none": ("PINHOLE", ()),
    "simple_radial": ("SIMPLE_RADIAL", (-0.06,)),
    "opencv": ("OPENCV", (-0.09, 0.015, 0.0012, -0.0008)),
    "opencv_fisheye": ("OPENCV_FISHEYE", (0.03, -0.008, 0.0, 0.0)),
    "fisheye_190": ("OPENCV_FISHEYE", (-0.02, 0.001, 0.0, 0.0)),
    "equirectangular": ("EQUIRECTANGULAR", ()),
}
# The lenses with rays at 90 degrees and more from the optical axis, and the radius of the image
# circle as a share of the shorter side (None for the whole image).
WIDE: dict[str, float | None] = {"fisheye_190": 0.48, "equirectangular": None}
FISHEYE_HALF_ANGLE = np.radians(95)


def lens(distortion: str, width: int, height: int) -> Camera:
    """The demo's camera. ``distortion`` is a key of ``LENSES``; the sizes are in pixels."""
    model, coefficients = LENSES[distortion]
    if model == "EQUIRECTANGULAR":
        return Camera(model, width, height, np.array([width, height], np.float64))
    focal = FOCAL_MM / SENSOR_WIDTH_MM * width
    circle = WIDE.get(distortion)
    if circle is not None:
        k1, k2 = coefficients[:2]
        angle = FISHEYE_HALF_ANGLE
        focal = circle * min(width, height) / (angle + k1 * angle**3 + k2 * angle**5)
    focals = [focal] if model.startswith("SIMPLE") else [focal, focal]
    return Camera(model, width, height, np.array([*focals, width / 2, height / 2, *coefficients]))


def focal_35mm(width: int, height: int) -> int:
    """EXIF's FocalLengthIn35mmFilm by the diagonal, which is 43.27 mm on film (CIPA DCG-001)."""
    sensor_diagonal = SENSOR_WIDTH_MM * float(np.hypot(1.0, height / width))
    return round(FOCAL_MM * float(np.hypot(36.0, 24.0)) / sensor_diagonal)


def orbit(names: list[str], seed: int) -> list[PosedImage]:
    """Cameras on a wavy ring around the objects, looking at them, with neighbours in order."""
    rng = np.random.default_rng([seed, 1])
    step = np.radians(min(360.0 / len(names), MAX_STEP_DEGREES))
    start, radius_phase, height_phase = rng.uniform(0, 2 * np.pi, 3)
    posed = []
    for i, name in enumerate(names):
        angle = start + i * step
        radius = 2.3 + 0.25 * np.sin(2 * angle + radius_phase) + rng.uniform(-0.05, 0.05)
        height = 1.25 + 0.40 * np.sin(3 * angle + height_phase) + rng.uniform(-0.05, 0.05)
        centre = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        target = np.array([0.0, 0.0, 0.45]) + rng.uniform(-0.1, 0.1, 3)
        rotation = look_at(centre, target, roll=rng.uniform(-0.05, 0.05))
        posed.append(PosedImage(name, 1, rotation, -rotation @ centre))
    return posed


def look_at(centre: Array, target: Array, roll: float = 0.0) -> Array:
    """(3, 3) world-to-camera rotation of a camera that looks at ``target``; roll in radians."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * right + s * down, c * down - s * right, forward])
