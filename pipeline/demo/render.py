"""One view of the demo scene: linear light, coverage and exact depth through a given lens."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.demo.lighting import REFERENCE_LIGHT, Light
from pipeline.demo.scene import BACKGROUND, SceneObject, shade, trace
from pipeline.geometry.cameras import Camera
from pipeline.geometry.distortion import unproject
from pipeline.geometry.rays import rays as unit_rays
from pipeline.scene.reconstruction import PosedImage

Array = NDArray[np.float64]

SAMPLES = 2  # Rays per pixel and axis.
# The sigma of the lens blur in pixels. It avoids aliasing, also in the Bayer mosaic.
LENS_SIGMA = 0.65
MARGIN = 3  # Pixels rendered around the image for the lens blur.
# The sigma of the texture filter in pixels; the lens blur is applied in addition.
TEXTURE_SIGMA = 0.35
RAYS_PER_BATCH = 32_768


@dataclass(frozen=True)
class Rays:
    """Rays of a camera as (3, rows, columns) vectors in its frame, the same for all photographs: of
    depth 1, or unit vectors for a wide lens, with NaN outside its image circle.

    Attributes:
        fine: The rays of SAMPLES per pixel and axis, with a margin of MARGIN pixels.
        centres: The rays through the centres of the pixels.
    """

    fine: Array
    centres: Array


@dataclass(frozen=True)
class Rendered:
    """The exact image and depth of a view.

    Attributes:
        light: (H, W, 3) float64 linear RGB, multiplied by alpha if ``transparent``.
        coverage: (H, W) float64 shares of the pixels covered by visitors, or by any object
            (``transparent``); 1 without both.
        depth: (H, W) float32 z of the scene's surface at the pixel centre, or its distance for a
            wide lens, ignoring visitors; 0 if there is no surface.
    """

    light: Array
    coverage: Array
    depth: NDArray[np.float32]


def rays(camera: Camera, wide: bool = False, max_angle: float = np.pi) -> Rays:
    """The rays of a camera.

    Args:
        wide: Whether the lens sees at 90 degrees and more from its axis.
        max_angle: The largest angle in radians from its axis at which a wide lens sees.
    """
    fine, centres = _grid(camera, SAMPLES, MARGIN, wide), _grid(camera, 1, 0, wide)
    if wide:
        limit = np.cos(max_angle)
        fine, centres = (np.where(grid[2] >= limit, grid, np.nan) for grid in (fine, centres))
    return Rays(fine, centres)


def render(
    posed: PosedImage,
    camera: Camera,
    through: Rays,
    objects: tuple[SceneObject, ...],
    *,
    transparent: bool = False,
    visitors: int = 0,
    lit: Light = REFERENCE_LIGHT,
) -> Rendered:
    """Render one view.

    Args:
        through: The rays of the camera (``rays(camera)``).
        transparent: Whether to leave out the room. Coverage is then the objects' alpha.
        visitors: The number of last objects that do not belong to the scene. If there are any,
            coverage is their share.
        lit: The light of the scene.
    """
    scene = objects[: len(objects) - visitors]
    rows, columns = through.fine.shape[1:]
    flat = through.fine.reshape(3, -1)
    layers = np.empty((4, flat.shape[1]))
    pixel = TEXTURE_SIGMA / camera.pinhole[0]
    for start in range(0, flat.shape[1], RAYS_PER_BATCH):
        part = slice(start, start + RAYS_PER_BATCH)
        seen = np.isfinite(flat[0, part])
        origin, direction = _world(posed, _or_forward(flat[:, part]))
        t, index = trace(origin, direction, objects)
        light = shade(origin, direction, t, index, pixel * t, objects, lit)
        if transparent:
            inside = index != BACKGROUND
            light *= inside
        else:
            inside = index >= len(scene) if visitors else np.ones(index.shape, bool)
        light = np.where(seen, light, 0.0)
        layers[:3, part], layers[3, part] = light, inside
    picture = np.ascontiguousarray(layers.reshape(4, rows, columns).transpose(1, 2, 0))
    picture = developed(picture, camera.width, camera.height)

    centres = through.centres.reshape(3, -1)
    origin, direction = _world(posed, _or_forward(centres))
    t, index = trace(origin, direction, scene)
    nothing = ((index == BACKGROUND) & transparent) | ~np.isfinite(centres[0])
    depth = np.where(nothing, 0.0, t).astype(np.float32)
    return Rendered(picture[..., :3], picture[..., 3], depth.reshape(camera.height, camera.width))


def developed(picture: NDArray, width: int, height: int) -> NDArray:
    """(height, width, K) pixel values of the light along the fine rays, through the lens blur.

    Args:
        picture: (R, C, K) values, one for each ray of ``Rays.fine``.
    """
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), LENS_SIGMA * SAMPLES))
    shape = (height + 2 * MARGIN, SAMPLES, width + 2 * MARGIN, SAMPLES, picture.shape[-1])
    return picture.reshape(shape).mean(axis=(1, 3))[MARGIN:-MARGIN, MARGIN:-MARGIN]


def _grid(camera: Camera, samples: int, margin: int, wide: bool) -> Array:
    x = (np.arange((camera.width + 2 * margin) * samples) + 0.5) / samples - margin
    y = (np.arange((camera.height + 2 * margin) * samples) + 0.5) / samples - margin
    if camera.is_spherical:
        x, y = x % camera.width, np.clip(y, 0.0, camera.height)
    xy = np.stack(np.meshgrid(x, y), axis=-1)
    if wide:
        return np.ascontiguousarray(np.moveaxis(unit_rays(camera, xy), -1, 0))
    plane = np.moveaxis(unproject(camera, xy), -1, 0)
    return np.concatenate([plane, np.ones_like(plane[:1])])


def _or_forward(vectors: Array) -> Array:
    """(3, N) rays, with the optical axis where there is none."""
    return np.where(np.isfinite(vectors[0]), vectors, np.array([[0.0], [0.0], [1.0]]))


def _world(posed: PosedImage, points: Array) -> tuple[Array, Array]:
    """The origin (3, 1) and the directions (3, N) of rays: of depth 1, so that a hit's t is its z
    depth, or unit vectors.

    The product is written out: BLAS may round differently with another number of threads.
    """
    right, down, forward = (row[:, None] for row in posed.rotation)
    return posed.centre[:, None], right * points[0] + down * points[1] + forward * points[2]
