"""Lens distortion of COLMAP's camera models and its inverse, vectorised.

Formulas: COLMAP's documentation, "Camera Models"; OpenCV's "Camera Calibration" and "Fisheye
camera model" for FULL_OPENCV and OPENCV_FISHEYE; the models of ``pipeline.geometry.lens_models``
are there. Normalised coordinates are (x / z, y / z) of a point in the camera's frame, without unit.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.geometry.lens_models import LENS_MODELS

Array = NDArray[np.float64]

# Newton's method: the maximum number of steps, and the largest error of a solution in normalised
# coordinates.
MAX_ITERATIONS = 50
MAX_ERROR = 1e-9


def distort(camera: Camera, points: Array) -> Array:
    """Apply the lens distortion: (..., 2) to (..., 2), both in normalised coordinates."""
    if camera.model in LENS_MODELS:
        return LENS_MODELS[camera.model].distort(points, np.array(_radial(camera)))
    if "FISHEYE" in camera.model:
        radius = np.linalg.norm(points, axis=-1, keepdims=True)
        theta = np.arctan(radius)
        scale = theta * _polynomial(theta**2, _radial(camera)) / np.maximum(radius, 1e-12)
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
        return LENS_MODELS[camera.model].undistort(points, np.array(_radial(camera)))
    if "FISHEYE" in camera.model:
        return _undistort_fisheye(camera, points)
    found = np.array(points, dtype=np.float64)
    step = 1e-6
    dx, dy = np.array([step, 0.0]), np.array([0.0, step])
    with np.errstate(all="ignore"):
        for _ in range(MAX_ITERATIONS):
            error = distort(camera, found) - points
            column_x = distort(camera, found + dx) - distort(camera, found - dx)
            column_y = distort(camera, found + dy) - distort(camera, found - dy)
            (a, c), (b, d) = np.moveaxis(column_x, -1, 0), np.moveaxis(column_y, -1, 0)
            determinant = (a * d - b * c) / (2 * step)
            move = np.stack(
                [d * error[..., 0] - b * error[..., 1], a * error[..., 1] - c * error[..., 0]],
                axis=-1,
            )
            found -= move / determinant[..., None]
            if np.nanmax(np.abs(error), initial=0.0) < MAX_ERROR / 100:
                break
        error = np.abs(distort(camera, found) - points).max(axis=-1)
        # Beyond the fold radius the polynomial decreases, which no real lens does.
        good = (error < MAX_ERROR) & (np.linalg.norm(found, axis=-1) < fold_radius(camera))
    found[~good] = np.nan
    return found


def fold_radius(camera: Camera) -> float:
    """The largest undistorted radius, in normalised coordinates, up to which the distorted radius
    increases; infinity if it always does."""
    if camera.model in LENS_MODELS:
        return LENS_MODELS[camera.model].fold_radius(np.array(_radial(camera)))
    if "FISHEYE" in camera.model:
        theta = _first_descent(lambda t: t * _polynomial(t**2, _radial(camera)), np.pi / 2)
        return float(np.tan(theta)) if theta < np.pi / 2 else np.inf
    numerator, denominator, _ = _perspective(camera)
    limit = 20.0  # tan(87 degrees)
    radius = _first_descent(
        lambda r: r * _polynomial(r**2, numerator) / _polynomial(r**2, denominator), limit
    )
    return radius if radius < limit else np.inf


def project(camera: Camera, points: Array) -> Array:
    """Undistorted normalised coordinates (..., 2) to distorted pixels (..., 2)."""
    fx, fy, cx, cy = camera.pinhole
    return distort(camera, points) * (fx, fy) + (cx, cy)


def unproject(camera: Camera, xy: Array) -> Array:
    """Distorted pixels (..., 2) to undistorted normalised coordinates (..., 2); NaN as for
    ``undistort``."""
    fx, fy, cx, cy = camera.pinhole
    return undistort(camera, (xy - (cx, cy)) / (fx, fy))


def _undistort_fisheye(camera: Camera, points: Array) -> Array:
    coefficients = _radial(camera)
    slopes = [(2 * i + 3) * k for i, k in enumerate(coefficients)]
    distorted = np.linalg.norm(points, axis=-1)
    theta = np.minimum(distorted, np.pi / 2)
    with np.errstate(all="ignore"):
        for _ in range(MAX_ITERATIONS):
            error = theta * _polynomial(theta**2, coefficients) - distorted
            theta = theta - error / _polynomial(theta**2, slopes)
            if np.nanmax(np.abs(error), initial=0.0) < MAX_ERROR / 100:
                break
        error = np.abs(theta * _polynomial(theta**2, coefficients) - distorted)
        good = (error < MAX_ERROR) & (theta >= 0) & (theta < np.arctan(fold_radius(camera)))
        good &= theta < np.pi / 2 - 1e-6
        scale = np.where(distorted > 1e-12, np.tan(theta) / np.maximum(distorted, 1e-12), 1.0)
    scale = np.where(good, scale, np.nan)
    return np.asarray(points * scale[..., None])


def _polynomial(t: Array, coefficients: list[float]) -> Array:
    """1 + c0 t + c1 t^2 + ..."""
    result = np.zeros_like(t)
    for c in reversed(coefficients):
        result = (result + c) * t
    return result + 1.0


def _radial(camera: Camera) -> list[float]:
    return [float(v) for v in camera.params[len(camera.intrinsics_names) :]]


def _perspective(camera: Camera) -> tuple[list[float], list[float], tuple[float, float]]:
    """Coefficients of the radial numerator and denominator, and the tangential ones (p1, p2)."""
    rest = _radial(camera)
    if camera.model in ("OPENCV", "FULL_OPENCV"):
        k1, k2, p1, p2 = rest[:4]
        higher = rest[4:]
        return [k1, k2, *higher[:1]], higher[1:], (p1, p2)
    return rest, [], (0.0, 0.0)


def _first_descent(function: Callable[[Array], Array], limit: float) -> float:
    """The first argument in [0, ``limit``] at which ``function`` stops increasing, on a fine grid;
    ``limit`` if there is none."""
    grid = np.linspace(0.0, limit, 20_001)
    falling = np.flatnonzero(np.diff(function(grid)) <= 0)
    return float(grid[falling[0]]) if len(falling) else limit
