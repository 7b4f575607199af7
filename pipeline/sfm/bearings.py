"""Rays of pycolmap cameras for the quality check of wide lenses.

COLMAP's normalised coordinates end at 90 degrees from the optical axis, and its rays of fisheye
lenses too; ``geometry.rays`` has no such limit.
"""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.geometry import rays
from pipeline.geometry.cameras import Camera

Floats = NDArray[np.float64]


def is_wide(camera: pycolmap.Camera) -> bool:
    """Whether the camera may see at 90 degrees or more from its optical axis."""
    return bool(camera.is_spherical()) or "FISHEYE" in camera.model_name


def camera_rays(camera: pycolmap.Camera, xy: Floats) -> Floats:
    """(N, 3) unit rays through (N, 2) pixels; NaN where there is none."""
    return rays.rays(_plain(camera), xy)


def camera_pixels(camera: pycolmap.Camera, points: Floats) -> Floats:
    """(N, 2) pixels of (N, 3) points in the camera's frame; NaN where there is none."""
    return rays.pixels(_plain(camera), points)


def pixels_per_radian(camera: pycolmap.Camera) -> float:
    """At the image's centre."""
    if camera.is_spherical():
        return float(camera.width / (2 * np.pi))
    return float(camera.mean_focal_length())


def image_side(camera: pycolmap.Camera) -> float:
    """The longer side in pixels, to which tolerances are relative; of a panorama the width of 90
    degrees, which an ordinary photograph may show."""
    if camera.is_spherical():
        return camera.width / 4
    return float(max(camera.width, camera.height))


def _plain(camera: pycolmap.Camera) -> Camera:
    params = np.array(camera.params, np.float64)
    return Camera(camera.model_name, camera.width, camera.height, params)
