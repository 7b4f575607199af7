"""The camera models of COLMAP that are neither OpenCV's perspective nor its fisheye model.

Functions map normalised coordinates (x / z, y / z) to those of the image, (pixel - principal point)
/ focal length, and back; both are (..., 2) without unit. Formulas: COLMAP's ``sensor/models.h``.

- FOV: Devernay and Faugeras, "Straight lines have to be straight", 2001.
- THIN_PRISM_FISHEYE: Schoeps et al., "A Multi-View Stereo Benchmark" (ETH3D), 2017.
- RAD_TAN_THIN_PRISM_FISHEYE: "FisheyeRadTanThinPrism" of Project Aria, equal in both axes.
- DIVISION: Fitzgibbon, "Simultaneous linear estimation of multiple view geometry and lens
  distortion", 2001.
- FISHEYE: equidistant projection.
- EUCM: Khomutenko et al., "An Enhanced Unified Camera Model", 2016.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_TINY = 1e-12
_ITERATIONS = 50
# Largest error of an inverse, in normalised coordinates.
MAX_ERROR = 1e-9


@dataclass(frozen=True)
class LensModel:
    """A lens model; the last argument of each function is the (K,) distortion coefficients.

    Attributes:
        distort: The function from normalised coordinates to those of the image.
        undistort: The inverse; NaN without one.
        fold_radius: The largest undistorted radius up to which the distorted one increases.
    """

    distort: Callable[[Array, Array], Array]
    undistort: Callable[[Array, Array], Array]
    fold_radius: Callable[[Array], float]


def _radius(points: Array) -> Array:
    return np.asarray(np.linalg.norm(points, axis=-1, keepdims=True))


def to_angles(points: Array) -> Array:
    """The point at the distance theta from the centre, in the same direction."""
    radius = _radius(points)
    safe = np.maximum(radius, _TINY)
    return np.where(radius > _TINY, points * np.arctan(radius) / safe, points)


def _from_angles(points: Array) -> Array:
    """The inverse of ``to_angles``; NaN at 90 degrees or more."""
    theta = _radius(points)
    safe = np.maximum(theta, _TINY)
    result = np.where(theta > _TINY, points * np.tan(theta) / safe, points)
    return np.where(theta < np.pi / 2 - 1e-6, result, np.nan)


def _unlimited(rest: Array) -> float:
    return float("inf")


def _distort_fov(points: Array, rest: Array) -> Array:
    omega = float(rest[0])
    radius = _radius(points)
    if abs(omega) < 1e-6:
        return points
    safe = np.maximum(radius, _TINY)
    scale = np.arctan(2 * safe * np.tan(omega / 2)) / (omega * safe)
    return np.asarray(points * scale)


def _undistort_fov(points: Array, rest: Array) -> Array:
    omega = float(rest[0])
    radius = _radius(points)
    if abs(omega) < 1e-6:
        return points
    safe = np.maximum(radius, _TINY)
    scale = np.tan(safe * omega) / (2 * safe * np.tan(omega / 2))
    return np.where(radius * abs(omega) < np.pi / 2 - 1e-6, points * scale, np.nan)


def _distort_division(points: Array, rest: Array) -> Array:
    root = 1 - 4 * float(rest[0]) * _radius(points) ** 2
    return np.where(root >= 0, 2 * points / (1 + np.sqrt(np.maximum(root, 0))), np.nan)


def _undistort_division(points: Array, rest: Array) -> Array:
    k, square = float(rest[0]), _radius(points) ** 2
    # A positive k has its fold at the distorted radius 1 / sqrt(k).
    good = (1 + k * square > _TINY) & (k * square < 1)
    return np.where(good, points / np.where(good, 1 + k * square, 1.0), np.nan)


def _fold_division(rest: Array) -> float:
    k = float(rest[0])
    return 0.5 / float(np.sqrt(k)) if k > 0 else float("inf")


def _distort_eucm(points: Array, rest: Array) -> Array:
    alpha, beta = rest
    return np.asarray(points / (alpha * np.sqrt(beta * _radius(points) ** 2 + 1) + 1 - alpha))


def _undistort_eucm(points: Array, rest: Array) -> Array:
    alpha, beta = rest
    square = _radius(points) ** 2
    root = 1 - (2 * alpha - 1) * beta * square
    depth = (1 - beta * alpha**2 * square) / (alpha * np.sqrt(np.maximum(root, 0)) + 1 - alpha)
    good = (root >= 0) & (depth > 1e-6)
    return np.where(good, points / np.where(good, depth, 1.0), np.nan)


def _thin_prism(angles: Array, rest: Array) -> Array:
    k1, k2, p1, p2, k3, k4, sx1, sy1 = rest
    u, v = angles[..., 0], angles[..., 1]
    r2 = u * u + v * v
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    return np.stack(
        [
            u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + sx1 * r2,
            v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v) + sy1 * r2,
        ],
        axis=-1,
    )


def _rad_tan(angles: Array, rest: Array) -> Array:
    square = _radius(angles) ** 2
    radial = np.zeros_like(square)
    for k in reversed(rest[:6]):
        radial = (radial + k) * square
    p0, p1, s0, s1, s2, s3 = rest[6:]
    points = angles * (1 + radial)
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    return np.stack(
        [
            x + (2 * x * x + r2) * p0 + 2 * x * y * p1 + s0 * r2 + s1 * r2 * r2,
            y + (2 * y * y + r2) * p1 + 2 * x * y * p0 + s2 * r2 + s3 * r2 * r2,
        ],
        axis=-1,
    )


def _angular(polynomial: Callable[[Array, Array], Array]) -> LensModel:
    """The model that applies ``polynomial`` to the angles of an equidistant projection."""

    def fold(rest: Array) -> float:
        """The first angle at which a radius decreases, on the two axes and their diagonals."""
        theta = np.linspace(0.0, np.pi / 2, 2001)
        directions = np.arange(8) * np.pi / 4
        rays = np.stack([np.cos(directions), np.sin(directions)], -1)[:, None] * theta[:, None]
        with np.errstate(all="ignore"):
            radius = _radius(polynomial(rays, rest))[..., 0]
        falling = np.flatnonzero(~(np.diff(radius, axis=1) > 0).all(0))
        return float(np.tan(theta[falling[0]])) if len(falling) else float("inf")

    def undistort(points: Array, rest: Array) -> Array:
        found = solve(lambda angles: polynomial(angles, rest), points)
        found = np.where(_radius(found) <= np.arctan(fold(rest)), found, np.nan)
        return _from_angles(found)

    return LensModel(lambda points, rest: polynomial(to_angles(points), rest), undistort, fold)


def solve(function: Callable[[Array], Array], target: Array) -> Array:
    """The arguments near ``target`` at which ``function`` has the values ``target``, by Newton's
    method with numerical derivatives; (..., 2) to (..., 2), NaN where it does not converge."""
    found = np.array(target, dtype=np.float64)
    step = 1e-6
    dx, dy = np.array([step, 0.0]), np.array([0.0, step])
    with np.errstate(all="ignore"):
        for _ in range(_ITERATIONS):
            error = function(found) - target
            a, c = np.moveaxis(function(found + dx) - function(found - dx), -1, 0)
            b, d = np.moveaxis(function(found + dy) - function(found - dy), -1, 0)
            determinant = (a * d - b * c) / (2 * step)
            move = [d * error[..., 0] - b * error[..., 1], a * error[..., 1] - c * error[..., 0]]
            found -= np.stack(move, axis=-1) / determinant[..., None]
            if np.nanmax(np.abs(error), initial=0.0) < MAX_ERROR / 100:
                break
        good = np.abs(function(found) - target).max(axis=-1) < MAX_ERROR
    found[~good] = np.nan
    return found


_DIVISION = LensModel(_distort_division, _undistort_division, _fold_division)
_EQUIDISTANT = LensModel(
    lambda points, rest: to_angles(points), lambda points, rest: _from_angles(points), _unlimited
)
LENS_MODELS = {
    "FOV": LensModel(_distort_fov, _undistort_fov, _unlimited),
    "THIN_PRISM_FISHEYE": _angular(_thin_prism),
    "RAD_TAN_THIN_PRISM_FISHEYE": _angular(_rad_tan),
    "SIMPLE_DIVISION": _DIVISION,
    "DIVISION": _DIVISION,
    "SIMPLE_FISHEYE": _EQUIDISTANT,
    "FISHEYE": _EQUIDISTANT,
    "EUCM": LensModel(_distort_eucm, _undistort_eucm, _unlimited),
}
"""Name of the camera model -> its functions."""
