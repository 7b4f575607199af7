"""Maps from pinhole images to the distorted photographs that they are sampled from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.geometry.distortion import fold_radius, project, unproject
from pipeline.photos.load import Picture
from pipeline.scene.views import view_size

# The number of rows of the undistortion map that are computed at a time.
BATCH_ROWS = 256
# COLMAP's limits of the undistorted size relative to the size without distortion: the border of a
# wide lens may be at infinity.
MIN_SCALE, MAX_SCALE = 0.2, 2.0

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Lens:
    """The undistortion map of one camera.

    Attributes:
        target: The pinhole camera at the size that is written.
        x, y: (height, width) float32 positions in the distorted image, in cv2's pixel coordinates;
            None for a camera without distortion.
        valid: (height, width) bool, False for pixels outside the distorted image; None if all are
            inside.
    """

    target: Camera
    x: NDArray[np.float32] | None
    y: NDArray[np.float32] | None
    valid: NDArray[np.bool_] | None

    def remap(self, picture: Picture, interpolation: int, border: int) -> Picture:
        """Undistort an image at full resolution."""
        if self.x is None or self.y is None:
            return picture
        return np.asarray(cv2.remap(picture, self.x, self.y, interpolation, borderMode=border))


def pinhole_camera(camera: Camera, blank_pixels: float) -> Camera:
    """The PINHOLE camera of the undistorted images of ``camera``, with its focal lengths.

    Args:
        blank_pixels: 0 crops to the rectangle inside the undistorted image border, 1 contains the
            whole border; values between interpolate. This is as in COLMAP's undistorter, except
            that each side is cropped by itself around the principal point.
    """
    fx, fy, cx, cy = camera.pinhole
    width, height = float(camera.width), float(camera.height)
    x, y = np.arange(width + 1), np.arange(height + 1)
    sides = (
        (np.stack([np.zeros_like(y), y], -1), 0, -fx, cx),
        (np.stack([np.full_like(y, width), y], -1), 0, fx, width - cx),
        (np.stack([x, np.zeros_like(x)], -1), 1, -fy, cy),
        (np.stack([x, np.full_like(x, height)], -1), 1, fy, height - cy),
    )
    extents = []  # The pixels from the principal point to the left, right, top and bottom.
    for border, axis, focal, distorted in sides:
        undistorted = unproject(camera, border)[:, axis] * focal
        finite = undistorted[np.isfinite(undistorted)]
        inner = finite.min(initial=np.inf)
        outer = finite.max(initial=-np.inf) if len(finite) == len(undistorted) else np.inf
        inner, outer = np.clip((inner, outer), MIN_SCALE * distorted, MAX_SCALE * distorted)
        extents.append(outer * blank_pixels + inner * (1 - blank_pixels))
    left, right, top, bottom = extents
    x0, x1 = int(np.ceil(cx - left - 1e-6)), int(np.floor(cx + right + 1e-6))
    y0, y1 = int(np.ceil(cy - top - 1e-6)), int(np.floor(cy + bottom + 1e-6))
    params = np.array([fx, fy, cx - x0, cy - y0])
    return Camera("PINHOLE", max(x1 - x0, 1), max(y1 - y0, 1), params)


def pinhole_lens(source: Camera, blank_pixels: float, max_long_side: int) -> Lens:
    """The undistortion map of ``source``, to an image of at most ``max_long_side`` pixels."""
    if source.is_pinhole:
        size = (source.width, source.height)
        fx, fy, cx, cy = source.pinhole
        same = Camera("PINHOLE", *size, np.array([fx, fy, cx, cy]))
        return Lens(same.resized(*view_size(*size, max_long_side)), None, None, None)
    fold = fold_radius(source)

    def sample(points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        xy = project(source, points)
        inside = (xy >= 0) & (xy <= (source.width, source.height))
        return xy, inside.all(axis=-1) & (np.hypot(*np.moveaxis(points, -1, 0)) < fold)

    return mapped_lens(pinhole_camera(source, blank_pixels), sample, max_long_side)


def mapped_lens(
    pinhole: Camera,
    sample: Callable[[Floats], tuple[Floats, NDArray[np.bool_]]],
    max_long_side: int,
) -> Lens:
    """The map of a pinhole image.

    Args:
        pinhole: The camera of the image at full resolution.
        sample: The function that maps normalised coordinates (..., 2) of the pinhole camera to
            pixels (..., 2) of the photograph, and whether they are valid (...).
        max_long_side: The largest side in pixels of the image that is written.
    """
    size = (pinhole.width, pinhole.height)
    fx, fy, cx, cy = pinhole.pinhole
    map_x, map_y = np.empty((2, size[1], size[0]), np.float32)
    valid = np.empty((size[1], size[0]), bool)
    columns = (np.arange(size[0]) + 0.5 - cx) / fx
    for start in range(0, size[1], BATCH_ROWS):
        part = slice(start, min(start + BATCH_ROWS, size[1]))
        rows = (np.arange(part.start, part.stop) + 0.5 - cy) / fy
        xy, valid[part] = sample(np.stack(np.meshgrid(columns, rows), axis=-1))
        map_x[part], map_y[part] = xy[..., 0] - 0.5, xy[..., 1] - 0.5
    target = pinhole.resized(*view_size(*size, max_long_side))
    return Lens(target, map_x, map_y, None if valid.all() else valid)
