"""The depth map of a view by PatchMatch stereo, from coarse to fine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.mvs.patchmatch import CostOptions, Picture, SearchOptions, patchmatch
from pipeline.mvs.prior import depth_range, first_planes
from pipeline.photos.load import load_view, resize_area, resize_mask
from pipeline.scene.views import View, reduced_size, resized

# Pixels that are less opaque are excluded.
MIN_ALPHA = 128


@dataclass(frozen=True)
class Level:
    """The search at one resolution.

    Attributes:
        factor: The factor by which the view is reduced.
        iterations, num_random, first_step: Parameters of ``SearchOptions``.
    """

    factor: int
    iterations: int
    num_random: int
    first_step: float


@dataclass(frozen=True)
class StereoOptions:
    """Parameters of the estimation.

    Attributes:
        levels: The levels from coarse to fine; the last one has the whole resolution.
        min_side: Coarse levels are left out where the shorter side would be smaller, pixels. The
            first level that is not has the iterations, random planes and step of the coarsest.
        cost: The parameters of the matching cost.
    """

    levels: tuple[Level, ...] = (
        Level(4, iterations=6, num_random=8, first_step=2.0),
        Level(2, iterations=3, num_random=0, first_step=1.0),
        Level(1, iterations=1, num_random=0, first_step=0.5),
    )
    min_side: int = 24
    cost: CostOptions = field(default_factory=CostOptions)


def load_picture(view: View) -> Picture:
    """A view's pixels in grey. Pixels that its mask excludes or that are transparent are not
    valid.

    Raises:
        UserError: as ``load_view``.
    """
    pixels = load_view(view)
    grey = np.asarray(cv2.cvtColor(pixels.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    valid = np.ones(grey.shape, bool)
    if pixels.mask is not None:
        valid &= pixels.mask
    if pixels.alpha is not None:
        valid &= pixels.alpha >= MIN_ALPHA
    return Picture(view, grey, valid)


def reduced(picture: Picture, factor: int) -> Picture:
    """The picture at its size divided by ``factor``."""
    if factor == 1:
        return picture
    width, height = reduced_size(picture.view, factor)
    grey = np.asarray(resize_area(picture.grey, width, height), np.uint8)
    return Picture(
        resized(picture.view, width, height), grey, resize_mask(picture.valid, width, height)
    )


def estimate_planes(
    reference: Picture,
    sources: Sequence[Picture],
    xyz: NDArray[np.float64],
    seed: int,
    options: StereoOptions,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Planes and costs of a view's pixels; see ``patchmatch``.

    Args:
        sources: The source views; without any, no pixel gets a plane.
        xyz: (N, 3) the sparse points that the view sees.
        seed: The seed of random numbers; different for each view.
    """
    shape = reference.grey.shape
    if not sources or not reference.valid.any():
        return np.zeros((3, *shape), np.float32), np.full(shape, 2.0, np.float32)
    depths = depth_range(reference.view, [source.view for source in sources], xyz)
    planes: NDArray[np.float32] | None = None
    costs = np.full(shape, 2.0, np.float32)
    for number, level in enumerate(options.levels):
        is_last = number == len(options.levels) - 1
        if not is_last and min(shape) < options.min_side * level.factor:
            continue
        small = reduced(reference, level.factor)
        if planes is None:
            level = replace(options.levels[0], factor=level.factor)
            planes = first_planes(small.view, xyz, depths)
        else:
            planes = enlarged(planes, small.view)
        search = SearchOptions(
            depth_range=depths,
            iterations=level.iterations,
            num_random=level.num_random,
            first_step=level.first_step,
            seed=seed * len(options.levels) + number,
        )
        small_sources = [reduced(source, level.factor) for source in sources]
        planes, costs = patchmatch(small, small_sources, planes, search, options.cost)
    assert planes is not None
    return planes, costs


def enlarged(planes: NDArray[np.float32], view: View) -> NDArray[np.float32]:
    """Planes at the size of ``view``: those of the nearest pixels, continued to the new pixels.

    Args:
        planes: (3, h, w) of the same view at a smaller size.
    """
    _, height, width = planes.shape
    sx, sy = width / view.width, height / view.height
    x, y = (np.arange(view.width) + 0.5) * sx, (np.arange(view.height) + 0.5) * sy
    column = np.minimum(x.astype(np.intp), width - 1)
    row = np.minimum(y.astype(np.intp), height - 1)
    w, wx, wy = planes[:, row[:, None], column[None, :]]
    dx = (x - column - 0.5).astype(np.float32)
    dy = (y - row - 0.5).astype(np.float32)
    inverse = w + dx[None, :] * wx + dy[:, None] * wy
    return np.stack([np.where(w > 0, inverse, 0), wx * sx, wy * sy]).astype(np.float32)


def depth_of(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) camera z of planes (3, H, W); 0 without a plane."""
    found = planes[0] > 0
    return np.where(found, 1.0 / np.where(found, planes[0], 1.0), 0.0).astype(np.float32)


def normals_of(planes: NDArray[np.float32], view: View) -> NDArray[np.float32]:
    """(H, W, 3) unit normals in camera coordinates, towards the camera; 0 without a plane."""
    w, wx, wy = planes.astype(np.float64)
    x, y = np.arange(view.width) + 0.5 - view.cx, np.arange(view.height) + 0.5 - view.cy
    normal = np.stack([wx * view.fx, wy * view.fy, w - wx * x - wy * y[:, None]], axis=-1)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    unit = -normal / np.maximum(length, 1e-300)
    return np.where((w > 0)[..., None], unit, 0.0).astype(np.float32)
