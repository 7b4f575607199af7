"""Lens models of photogrammetry programs as cameras of COLMAP's models.

The Brown-Conrady model, with the coefficients' names of OpenCV's "Camera Calibration":

    x'' = x' (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + (2 p1 x'y' + p2 (r^2 + 2 x'^2)) t
    y'' = y' (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + (2 p2 x'y' + p1 (r^2 + 2 y'^2)) t
    t = 1 + p3 r^2 + p4 r^4
    u = fx x'' + skew y'' + cx,   v = fy y'' + cy

(x', y') is (x / z, y / z), for fisheye lenses at the distance theta from the centre.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.geometry.lens_fit import MAX_RESIDUAL_PX, fit_camera
from pipeline.geometry.lens_models import to_angles
from pipeline.io.poses.files import malformed
from pipeline.io.poses.frames import Lens, checked_camera

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Brown:
    """A lens of the Brown-Conrady model, see above; pixels, and coefficients without unit.

    Attributes:
        k: The radial coefficients, up to four.
        p: The tangential coefficients p1 and p2.
        p_radial: The coefficients p3 and p4.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k: tuple[float, ...] = ()
    p: tuple[float, float] = (0.0, 0.0)
    p_radial: tuple[float, float] = (0.0, 0.0)
    skew: float = 0.0
    fisheye: bool = False

    def project(self, points: Array) -> Array:
        """Normalised coordinates, (..., 2), to pixels, (..., 2)."""
        angles = to_angles(points) if self.fisheye else points
        x, y = angles[..., 0], angles[..., 1]
        r2 = x * x + y * y
        radial = np.zeros_like(r2)
        for k in reversed(self.k):
            radial = (radial + k) * r2
        (p1, p2), (p3, p4) = self.p, self.p_radial
        t = 1 + r2 * (p3 + r2 * p4)
        x2 = x * (1 + radial) + (2 * p1 * x * y + p2 * (r2 + 2 * x * x)) * t
        y2 = y * (1 + radial) + (2 * p2 * x * y + p1 * (r2 + 2 * y * y)) * t
        return np.stack([self.fx * x2 + self.skew * y2 + self.cx, self.fy * y2 + self.cy], -1)


def brown_camera(file: Path, where: str, width: float, height: float, lens: Brown) -> Camera:
    """The camera with this lens, of the simplest model that holds it.

    Args:
        width, height: The size in pixels.
        where: What messages call the camera.

    Raises:
        UserError: Impossible intrinsics, or a lens that no model of COLMAP describes to within
            ``MAX_RESIDUAL_PX``.
    """
    k1, k2, k3, k4 = (*lens.k, 0.0, 0.0, 0.0, 0.0)[:4]
    others = np.array([lens.skew, k1, k2, k3, k4, *lens.p, *lens.p_radial])
    if not np.isfinite(others).all():
        raise malformed(file, f"{where}: expected finite lens coefficients")
    rest = {
        "PINHOLE": (),
        "OPENCV": (k1, k2, *lens.p),
        "FULL_OPENCV": (k1, k2, *lens.p, k3, 0.0, 0.0, 0.0),
        "OPENCV_FISHEYE": (k1, k2, k3, k4),
        "THIN_PRISM_FISHEYE": (k1, k2, *lens.p, k3, k4, 0.0, 0.0),
    }[brown_model(lens)]
    model = brown_model(lens)
    params = (lens.fx, lens.fy, lens.cx, lens.cy, *rest)
    camera = checked_camera(file, where, model, width, height, params)
    if _is_exact(lens):
        return camera
    return fitted(file, where, camera, model, rest, lens)


def scaled_lens(
    file: Path,
    where: str,
    unit: Brown,
    scale: Callable[[int, int], float],
    *,
    from_centre: bool = True,
) -> Lens:
    """The lens of photographs whose size the file does not give.

    Args:
        unit: The lens in the unit of the file, whose principal point is counted from the image
            centre, or from the upper left corner without ``from_centre``.
        scale: The function from a photograph's width and height to the number of pixels of a unit.
    """

    def camera(width: int, height: int) -> Camera:
        pixels = scale(width, height)
        x, y = (width / 2, height / 2) if from_centre else (0.0, 0.0)
        fx, fy = unit.fx * pixels, unit.fy * pixels
        cx, cy = x + unit.cx * pixels, y + unit.cy * pixels
        lens = replace(unit, fx=fx, fy=fy, cx=cx, cy=cy)
        return brown_camera(file, where, width, height, lens)

    return Lens(brown_model(unit), camera)


def brown_model(lens: Brown) -> str:
    """The camera model of ``brown_camera``."""
    k1, k2, k3 = (*lens.k, 0.0, 0.0, 0.0)[:3]
    if lens.fisheye:
        simple = _is_exact(lens) and not any(lens.p)
        return "OPENCV_FISHEYE" if simple else "THIN_PRISM_FISHEYE"
    if k3 or not _is_exact(lens):
        return "FULL_OPENCV"
    return "OPENCV" if k1 or k2 or any(lens.p) else "PINHOLE"


def _is_exact(lens: Brown) -> bool:
    """Whether a model of COLMAP has all coefficients that are not zero."""
    fourth = any(lens.k[3:]) and not lens.fisheye
    return not (lens.skew or fourth or (any(lens.p) and any(lens.p_radial)))


@lru_cache(maxsize=64)
def _nearest(
    model: str, width: int, height: int, start: tuple[float, ...], lens: Brown
) -> tuple[Camera, float]:
    """``fit_camera``, once for all photographs of a lens: some programs write it for each."""
    return fit_camera(model, width, height, start, lens.project)


def fitted(
    file: Path,
    where: str,
    near: Camera,
    model: str,
    start: tuple[float, ...],
    lens: Brown,
) -> Camera:
    """The camera of a ``model`` that is fitted to ``lens``.

    Args:
        near: A camera with the size and intrinsics to start from.
        start: The distortion coefficients to start from.

    Raises:
        UserError: The largest error is ``MAX_RESIDUAL_PX`` or more.
    """
    first = (*near.pinhole, *start)
    camera, residual = _nearest(model, near.width, near.height, first, lens)
    if not residual < MAX_RESIDUAL_PX:
        found = f"{residual:.3g} px" if np.isfinite(residual) else "more than any limit"
        raise malformed(
            file,
            f"{where}: no camera model of COLMAP describes this lens: the nearest deviates by "
            f"{found} somewhere in the image, expected less than {MAX_RESIDUAL_PX} px",
            fix="calibrate the lens with fewer coefficients (no skew, k4, p3 or p4), or export "
            "undistorted photographs, or set poses: ignore",
        )
    return checked_camera(file, where, model, near.width, near.height, camera.params.tolist())
