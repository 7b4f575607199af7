"""The camera of one of COLMAP's models that is nearest to a lens of another model."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.geometry.distortion import fold_radius, project
from pipeline.geometry.lens_models import solve

Array = NDArray[np.float64]
#: Largest accepted error of a fitted camera, pixels.
MAX_RESIDUAL_PX = 0.05
# Sides of the grids of pixels for the fit, and for its largest error.
_FIT_GRID, _CHECK_GRID = 25, 41
# Steps of the fit, each of which evaluates the errors once and once for each parameter.
_MAX_STEPS = 60


def fit_camera(
    model: str, width: int, height: int, start: Sequence[float], lens: Callable[[Array], Array]
) -> tuple[Camera, float]:
    """Fit a camera to ``lens`` by least squares over the pixels of the image.

    Args:
        model: The model of the camera that is returned.
        width, height: The image size in pixels.
        start: The parameters to start from, near those of ``lens``.
        lens: The map from normalised coordinates (x / z, y / z), (..., 2), to pixels, (..., 2).

    Returns:
        The camera and the largest error over the image in pixels: infinity if ``lens`` has no
        inverse somewhere in the image.
    """
    from scipy.optimize import least_squares  # Heavy, and few scenes need it.

    first = Camera(model, width, height, np.array(start, np.float64))
    fx, fy, cx, cy = first.pinhole
    scale = np.array([fx, fy])

    def rays(side: int) -> Array:
        """Normalised coordinates of a grid of pixels, NaN where there are none."""
        x, y = np.linspace(0, width, side), np.linspace(0, height, side)
        pixels = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        target = (pixels - (cx, cy)) / scale
        return solve(lambda points: (lens(points) - (cx, cy)) / scale, target)

    def errors(params: Array, points: Array, expected: Array) -> Array:
        found = project(Camera(model, width, height, params), points) - expected
        return np.nan_to_num(found, nan=1e6, posinf=1e6, neginf=-1e6)

    with np.errstate(all="ignore"):
        points, check = rays(_FIT_GRID), rays(_CHECK_GRID)
        if not (np.isfinite(points).all() and np.isfinite(check).all()):
            return first, float("inf")
        expected = lens(points)
        unit = np.where(np.arange(len(first.params)) < len(first.intrinsics_names), fx, 1.0)
        # MINPACK: without BLAS, whose results depend on the number of threads.
        found = least_squares(
            lambda x: errors(x * unit, points, expected).ravel(),
            first.params / unit,
            method="lm",
            x_scale="jac",
            xtol=1e-10,
            ftol=1e-10,
            gtol=1e-10,
            max_nfev=_MAX_STEPS * (len(first.params) + 1),
        )
        camera = Camera(model, width, height, found.x * unit)
        residual = float(np.linalg.norm(errors(camera.params, check, lens(check)), axis=1).max())
        border = np.linalg.norm(check, axis=1).max()
        if residual < MAX_RESIDUAL_PX and not fold_radius(camera) > border:
            residual = float("inf")  # ``undistort`` gives no point beyond the fold.
    return camera, residual
