"""One view of the demo scene: linear light, coverage and exact depth through a given lens."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.demo.scene import BACKGROUND, Thing, shade, trace
from pipeline.geometry.cameras import Camera
from pipeline.geometry.distortion import unproject
from pipeline.scene.reconstruction import PosedImage

Array = NDArray[np.float64]

SAMPLES = 2  # rays a pixel and axis
# The lens's blur, in pixels: what keeps a real photograph free of aliasing, and a mosaic legible.
LENS_SIGMA = 0.65
MARGIN = 3  # pixels rendered around the picture for that blur
# The texture filter's sigma in pixels; the lens's blur does the rest.
TEXTURE_SIGMA = 0.35
RAYS_AT_ONCE = 32_768


@dataclass(frozen=True)
class Rays:
    """A camera's rays, alike for all of its photographs: (2, rows, columns) normalised points.

    Attributes:
        fine: SAMPLES a pixel and axis, MARGIN pixels around.
        centres: one a pixel, through its centre.
    """

    fine: Array
    centres: Array


@dataclass(frozen=True)
class Rendered:
    """What a view shows.

    Attributes:
        light: (H, W, 3) float64 linear RGB; multiplied by ``alpha`` where there is one.
        coverage: (H, W) float64, share of the pixel's light that the last thing of the scene
            gives (``visitor``) or that any object gives (``transparent``); else 1.
        depth: (H, W) float32, z of the scene's surface at the pixel's centre, behind a visitor;
            0 where there is none.
    """

    light: Array
    coverage: Array
    depth: NDArray[np.float32]


def rays(camera: Camera) -> Rays:
    fine = _grid(camera, SAMPLES, MARGIN)
    return Rays(fine, _grid(camera, 1, 0))


def render(
    posed: PosedImage,
    camera: Camera,
    through: Rays,
    things: tuple[Thing, ...],
    *,
    transparent: bool = False,
    visitor: bool = False,
) -> Rendered:
    """Render one view.

    Args:
        through: ``rays(camera)``.
        transparent: leave the room away; coverage is the objects' alpha.
        visitor: the last thing does not belong to the scene; coverage is its share.
    """
    rows, columns = through.fine.shape[1:]
    flat = through.fine.reshape(2, -1)
    layers = np.empty((4, flat.shape[1]))
    pixel = TEXTURE_SIGMA / camera.pinhole[0]
    for start in range(0, flat.shape[1], RAYS_AT_ONCE):
        part = slice(start, start + RAYS_AT_ONCE)
        origin, direction = _world(posed, flat[:, part])
        t, index = trace(origin, direction, things)
        light = shade(origin, direction, t, index, pixel * t, things)
        if transparent:
            inside = index != BACKGROUND
            light *= inside
        else:
            inside = index == len(things) - 1 if visitor else np.ones(index.shape, bool)
        layers[:3, part], layers[3, part] = light, inside
    picture = np.ascontiguousarray(layers.reshape(4, rows, columns).transpose(1, 2, 0))
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), LENS_SIGMA * SAMPLES), np.float64)
    height, width = camera.height + 2 * MARGIN, camera.width + 2 * MARGIN
    picture = picture.reshape(height, SAMPLES, width, SAMPLES, 4).mean(axis=(1, 3))
    picture = picture[MARGIN:-MARGIN, MARGIN:-MARGIN]

    origin, direction = _world(posed, through.centres.reshape(2, -1))
    t, index = trace(origin, direction, things[:-1] if visitor else things)
    depth = np.where((index == BACKGROUND) & transparent, 0.0, t).astype(np.float32)
    return Rendered(picture[..., :3], picture[..., 3], depth.reshape(camera.height, camera.width))


def _grid(camera: Camera, samples: int, margin: int) -> Array:
    x = (np.arange((camera.width + 2 * margin) * samples) + 0.5) / samples - margin
    y = (np.arange((camera.height + 2 * margin) * samples) + 0.5) / samples - margin
    xy = np.stack(np.meshgrid(x, y), axis=-1)
    return np.ascontiguousarray(np.moveaxis(unproject(camera, xy), -1, 0))


def _world(posed: PosedImage, points: Array) -> tuple[Array, Array]:
    """Origin (3, 1) and directions (3, N) of depth 1, so that a hit's t is its z depth.

    Written out rather than a matrix product: BLAS may round differently with other threads.
    """
    right, down, forward = (row[:, None] for row in posed.rotation)
    return posed.centre[:, None], right * points[0] + down * points[1] + forward
