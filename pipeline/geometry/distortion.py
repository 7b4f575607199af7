"""Lens distortion of COLMAP's camera models and its inverse, vectorised.

Formulas: COLMAP's documentation, "Camera Models"; OpenCV's "Camera Calibration" and "Fisheye
camera model" for FULL_OPENCV and OPENCV_FISHEYE; the models of ``pipeline.geometry.lens_models``
are there. Normalised coordinates are (x / z, y / z) of a point in the camera's frame, without unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.geometry.lens_models import LENS_MODELS, MAX_ERROR, solve

Array = NDArray[np.float64]

# Models whose distorted radius is a polynomial of the angle from the optical axis.
POLYNOMIAL_FISHEYES = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
# Number of intervals of the table that starts Newton's method for their inverse, and of its steps:
# they converge quadratically from an error of 1e-4 radians.
TABLE_SIZE, NEWTON_STEPS = 20_000, 4
# The largest undistorted radius of a perspective camera at which the fold is looked for: tan(87
# degrees).
MAX_RADIUS = 20.0


def distort(camera: Camera, points: Array) -> Array:
    """Apply the lens distortion: (..., 2) to (..., 2), both in normalised coordinates."""
    if camera.model in LENS_MODELS:
        return LENS_MODELS[camera.model].distort(points, camera.distortion)
    if camera.model in POLYNOMIAL_FISHEYES:
        radius = np.linalg.norm(points, axis=-1, keepdims=True)
        scale = fisheye_radius(camera, np.arctan(radius)) / np.maximum(radius, 1e-12)
        return np.asarray(np.where(radius > 1e-12, points * scale, points))
    numerator, denominator, (p1, p2) = _perspective(camera)
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = _polynomial(r2, numerator) / _polynomial(r2, denominator)
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
        ],
        axis=-1,
    )


def undistort(camera: Camera, points: Array) -> Array:
    """The inverse of ``distort``, by Newton's method.

    The result is NaN for points without an inverse: beyond ``fold_radius``, and for fisheye rays
    at 90 degrees or more from the optical axis, which have no normalised coordinates.
    """
    if camera.model in LENS_MODELS:
        return LENS_MODELS[camera.model].undistort(points, camera.distortion)
    if camera.model in POLYNOMIAL_FISHEYES:
        radius = np.linalg.norm(points, axis=-1, keepdims=True)
        theta = fisheye_angle(camera, radius)
        scale = np.where(radius > 1e-12, np.tan(theta) / np.maximum(radius, 1e-12), 1.0)
        return np.where(theta < np.pi / 2 - 1e-6, points * scale, np.nan)
    found = solve(partial(distort, camera), points)
    # Beyond the fold radius the polynomial decreases, which no real lens does.
    found[~(np.linalg.norm(found, axis=-1) < fold_radius(camera))] = np.nan
    return found


def fold_radius(camera: Camera) -> float:
    """The largest undistorted radius, in normalised coordinates, up to which the distorted radius
    increases; infinity if it always does."""
    if camera.model in LENS_MODELS:
        return LENS_MODELS[camera.model].fold_radius(camera.distortion)
    if camera.model in POLYNOMIAL_FISHEYES:
        theta = max_fisheye_angle(camera)
        return float(np.tan(theta)) if theta < np.pi / 2 else np.inf
    numerator, denominator, _ = _perspective(camera)
    grid = np.linspace(0.0, MAX_RADIUS, TABLE_SIZE + 1)
    distorted = grid * _polynomial(grid**2, numerator) / _polynomial(grid**2, denominator)
    radius = _first_descent(grid, distorted)
    return radius if radius < MAX_RADIUS else np.inf


def fisheye_radius(camera: Camera, theta: Array) -> Array:
    """The distorted radii, in focal lengths, of angles from the axis of a polynomial fisheye."""
    return theta * _polynomial(theta**2, camera.distortion)


def fisheye_angle(camera: Camera, radius: Array) -> Array:
    """The inverse of ``fisheye_radius``, radians; NaN beyond ``max_fisheye_angle``."""
    limit = max_fisheye_angle(camera)
    table = np.linspace(0.0, limit, TABLE_SIZE + 1)
    slopes = camera.distortion * np.arange(3, 3 + 2 * len(camera.distortion), 2)
    theta = np.interp(radius, fisheye_radius(camera, table), table)
    with np.errstate(all="ignore"):
        for _ in range(NEWTON_STEPS):
            step = (fisheye_radius(camera, theta) - radius) / _polynomial(theta**2, slopes)
            theta = np.clip(theta - np.nan_to_num(step), 0.0, limit)
        good = np.abs(fisheye_radius(camera, theta) - radius) < MAX_ERROR
    return np.where(good, theta, np.nan)


def max_fisheye_angle(camera: Camera) -> float:
    """The angle from the axis of a polynomial fisheye, up to pi, at which the distortion folds."""
    angles = np.linspace(0.0, np.pi, TABLE_SIZE + 1)
    return _first_descent(angles, fisheye_radius(camera, angles))


def project(camera: Camera, points: Array) -> Array:
    """Undistorted normalised coordinates (..., 2) to distorted pixels (..., 2)."""
    fx, fy, cx, cy = camera.pinhole
    return distort(camera, points) * (fx, fy) + (cx, cy)


def unproject(camera: Camera, xy: Array) -> Array:
    """Distorted pixels (..., 2) to undistorted normalised coordinates (..., 2); NaN as for
    ``undistort``."""
    fx, fy, cx, cy = camera.pinhole
    return undistort(camera, (xy - (cx, cy)) / (fx, fy))


def _polynomial(t: Array, coefficients: Sequence[float] | Array) -> Array:
    """1 + c0 t + c1 t^2 + ..."""
    result = np.zeros_like(t)
    for c in coefficients[::-1]:
        result = (result + c) * t
    return result + 1.0


def _perspective(camera: Camera) -> tuple[list[float], list[float], tuple[float, float]]:
    """Coefficients of the radial numerator and denominator, and the tangential ones (p1, p2)."""
    rest = camera.distortion.tolist()
    if camera.model in ("OPENCV", "FULL_OPENCV"):
        k1, k2, p1, p2 = rest[:4]
        higher = rest[4:]
        return [k1, k2, *higher[:1]], higher[1:], (p1, p2)
    return rest, [], (0.0, 0.0)


def _first_descent(arguments: Array, values: Array) -> float:
    """The first argument at which the values stop increasing; the last one if there is none."""
    falling = np.flatnonzero(np.diff(values) <= 0)
    return float(arguments[falling[0] if len(falling) else -1])
