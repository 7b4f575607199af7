"""Partition of a scene into blocks of similar training cost.

Following VastGaussian (Lin et al. 2024) and CityGaussian (Liu et al. 2024), blocks are boxes that
get the views in which they are seen. Cost and visibility are those of the coarse Gaussians: a
block's cost is the number of pixels of all views that its Gaussians explain, behind what occludes
them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.config.schema import Train
from pipeline.plan.budget import TRAINING_PIXELS_PER_GAUSSIAN
from pipeline.render import Backend, RasterOptions, make_backend
from pipeline.render.contributions import contributions, in_grey
from pipeline.render.views import near_plane, raster_camera
from pipeline.scene.blocks import Block, BlockView, Box, Partition, bounds_of
from pipeline.scene.manifest import Manifest
from pipeline.scene.views import View, scene_extent, scene_up
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.skybox import Sky
from pipeline.training.blocks.shares import IMAGE_FACTOR, SHOWN_SHARE, explained_shares
from pipeline.training.data.targets import usable_factor

Array = NDArray[np.float64]

# A view belongs to the blocks that explain at least this share of its pixels.
MIN_VIEW_SHARE = 0.005
# Windows are this much larger than the block in them, pixels of the view.
WINDOW_MARGIN = 8
# Sides of windows are multiples of this, pixels: in smaller ones, SSIM's windows of 11 pixels
# mostly cover borders, and buffers of few sizes are reused.
WINDOW_UNIT = 64
# Margins cover the extent (3 standard deviations) of this share of the Gaussians near a face, and
# are at least and at most these shares of the scene's extent along the axis.
MARGIN_SHARE, MIN_MARGIN, MAX_MARGIN = 0.9, 0.01, 0.1
# The extent of a scene along an axis: between these quantiles of the explained pixels.
EXTENT_QUANTILES = 0.02, 0.98
# The far field begins at this distance from the scene, in extents of the scene.
FAR_SHARE = 0.5
MIN_BLOCK_GAUSSIANS = 1000
# Views that look through the region of a block in this share of their pixels, outside of their
# window, are its overviews. One in so many reduced pixels is examined, in both directions.
MIN_THROUGH_SHARE, RAY_STEP = 0.02, 4


@dataclass(frozen=True)
class PartitionOptions:
    """The settings that determine a partition, besides the coarse Gaussians and the views.

    Attributes:
        blocks: The number of blocks.
        axes: (3, 3) float64, directions of the faces as rows, orthonormal.
        max_gaussians: The upper limit of the number of Gaussians of a block that fills its views.
        view_pixels: The number of pixels of a typical view.
        pixels_per_gaussian: The number of training pixels of all views together per Gaussian.
        steps: The number of steps of one block for the whole scene.
        raster: The options of rendering, with the near plane and antialiasing of the training.
    """

    blocks: int
    axes: Array
    max_gaussians: int
    view_pixels: int
    pixels_per_gaussian: float
    steps: int
    raster: RasterOptions


@dataclass(frozen=True)
class _Cell:
    """A box during the division, and the rows of the coarse Gaussians in it."""

    lower: Array
    upper: Array
    rows: NDArray[np.int64]


def partition_scene(
    coarse: Gaussians,
    views: Sequence[View],
    manifest: Manifest,
    blocks: int,
    train: Train,
    *,
    threads: int,
) -> Partition:
    """The partition of a scene, with horizontal and vertical faces.

    Args:
        coarse: The Gaussians of the whole scene.
        views: All views, sorted by name.
    """
    training = [view for view in views if not view.is_test]
    sizes = Counter(view.width * view.height for view in training)
    options = PartitionOptions(
        blocks=blocks,
        axes=_axes(coarse.means.double().numpy(), scene_up(views, manifest)),
        max_gaussians=train.density.max_gaussians,
        view_pixels=sizes.most_common(1)[0][0],
        pixels_per_gaussian=TRAINING_PIXELS_PER_GAUSSIAN,
        steps=train.steps,
        raster=RasterOptions(
            antialias=train.antialias, near=near_plane(scene_extent(list(views))), threads=threads
        ),
    )
    return make_partition(coarse, training, options, make_backend())


def _axes(points: Array, up: Array) -> Array:
    """(3, 3) the horizontal directions of largest and smallest extent of (N, 3) points, and the
    upward one, as rows."""
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    flat = np.stack([first, np.cross(up, first)])
    # Use einsum, not a matrix product: BLAS may round differently with the number of threads.
    local = np.einsum("ij,nj->ni", flat, points)
    local = np.clip(local, *np.quantile(local, EXTENT_QUANTILES, axis=0))
    local -= local.mean(0)
    (xx, xy), (_, yy) = np.einsum("ni,nj->ij", local, local)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    long = np.cos(angle) * flat[0] + np.sin(angle) * flat[1]
    return np.stack([long, np.cross(up, long), up])


def make_partition(
    coarse: Gaussians, views: Sequence[View], options: PartitionOptions, backend: Backend
) -> Partition:
    """Divide the scene and choose the views of each block.

    Args:
        coarse: The Gaussians of the whole scene.
        views: The training views, sorted by name.
    """
    grey = in_grey(coarse)
    raster = replace(options.raster, sh_degree=0, background=None)
    factor = usable_factor(views, IMAGE_FACTOR)
    cameras = [raster_camera(view, factor) for view in views]
    pixels = np.zeros(len(coarse))
    for camera in cameras:
        pixels += contributions(grey, camera, raster, factor**2, backend).numpy()
    # The sky fills many pixels and would decide the division.
    sky = Sky(np.array([view.centre for view in views]))
    pixels[sky.contains(coarse.means.numpy(), pixels)] = 0
    whole = Box(options.axes, np.full(3, -np.inf), np.full(3, np.inf))
    local = whole.along_axes(coarse.means.numpy())
    reach = 3 * coarse.log_scales.amax(1).exp().double().numpy()
    cells = _divide(
        _Cell(whole.lower, whole.upper, np.arange(len(coarse))), options.blocks, local, pixels
    )
    margins = [_margins(cell, local, pixels, reach) for cell in cells]
    bounds = _bounds(views, whole, local, pixels)
    boxes = [
        Box(options.axes, cell.lower, cell.upper).expanded(*margin).clipped(*bounds)
        for cell, margin in zip(cells, margins, strict=True)
    ]
    regions = [box.contains(coarse.means.numpy()) for box in boxes]
    shares = [_Views(box) for box in boxes]
    for view, camera in zip(views, cameras, strict=True):
        maps, rendered = explained_shares(grey, regions, camera, raster, backend)
        rays = _Rays.of(view, rendered.median_depth.numpy())
        for found, share in zip(shares, maps, strict=True):
            found.add(view, share, rays)
    return Partition(
        axes=tuple(map(tuple, options.axes.tolist())),
        lower=tuple(bounds[0].tolist()),
        upper=tuple(bounds[1].tolist()),
        blocks=tuple(
            _block(cell, margin, region, found, len(views), options)
            for cell, margin, region, found in zip(cells, margins, regions, shares, strict=True)
        ),
    )


@dataclass(frozen=True)
class _Rays:
    """Rays of a view.

    Attributes:
        origin: (3,) the camera's centre in the world.
        directions: (N, 3), of camera z 1.
        depth: (N,) camera z of the surface that they meet, infinite without one.
        x, y: (N,) pixels of the view.
    """

    origin: Array
    directions: Array
    depth: Array
    x: Array
    y: Array

    @staticmethod
    def of(view: View, depth: NDArray[np.float32]) -> _Rays:
        """Some rays of a view, of which ``depth`` (h, w) is the reduced depth map."""
        rows, columns = (np.arange(RAY_STEP // 2, size, RAY_STEP) for size in depth.shape)
        y, x = np.meshgrid(rows, columns, indexing="ij")
        found = depth[y, x].astype(np.float64).ravel()
        x = (x.ravel() + 0.5) * view.width / depth.shape[1]
        y = (y.ravel() + 0.5) * view.height / depth.shape[0]
        local = np.stack([(x - view.cx) / view.fx, (y - view.cy) / view.fy, np.ones_like(x)], 1)
        directions = np.einsum("ji,nj->ni", view.world_to_camera[:3, :3], local)
        return _Rays(view.centre, directions, np.where(found > 0, found, np.inf), x, y)


class _Views:
    """The views of a block with this region, within the scene."""

    def __init__(self, region: Box) -> None:
        self.region = region
        self.views: list[BlockView] = []
        self.overviews: list[str] = []
        self.pixels: list[float] = []

    def add(self, view: View, share: NDArray[np.float32], rays: _Rays) -> None:
        """Add a view in which the block explains this share (h, w) of each reduced pixel, if it
        explains enough of them."""
        mean = float(share.mean(dtype=np.float64))
        shown = share > SHOWN_SHARE
        enter, leave = self.region.crossed(rays.origin, rays.directions)
        through = enter.clip(0) < np.minimum(leave, rays.depth)
        if mean >= MIN_VIEW_SHARE and shown.any():
            left, top, width, height = window = _window(shown, view)
            size = view.width, view.height
            self.views.append(
                BlockView(name=view.name, window=window, size=size, share=round(mean, 6))
            )
            self.pixels.append(mean * view.width * view.height)
            within = (rays.x >= left) & (rays.x < left + width)
            through &= ~(within & (rays.y >= top) & (rays.y < top + height))
        if through.mean() >= MIN_THROUGH_SHARE:
            self.overviews.append(view.name)


def _block(
    cell: _Cell,
    margin: tuple[Array, Array],
    region: NDArray[np.bool_],
    found: _Views,
    num_views: int,
    options: PartitionOptions,
) -> Block:
    count, typical = 0, 0.0
    if found.views:
        typical = sum(found.pixels) / len(found.pixels)
        count = round(sum(found.pixels) / options.pixels_per_gaussian)
    limit = min(round(options.max_gaussians * min(1.0, typical / options.view_pixels)), count)
    seen = len(found.views) + len(found.overviews)
    steps = round(options.steps * seen / num_views)
    return Block(
        lower=bounds_of(cell.lower),
        upper=bounds_of(cell.upper),
        margin_below=tuple(margin[0].tolist()),
        margin_above=tuple(margin[1].tolist()),
        gaussians=int(region.sum()),
        max_gaussians=max(MIN_BLOCK_GAUSSIANS, limit),
        steps=max(1, steps),
        views=tuple(found.views),
        overviews=tuple(found.overviews),
    )


def _divide(cell: _Cell, count: int, local: Array, pixels: Array) -> list[_Cell]:
    """Divide a cell into ``count``, by planes across the longest axis such that the explained
    pixels on both sides are in proportion to the number of cells (a k-d tree)."""
    if count == 1:
        return [cell]
    rows = cell.rows
    weight = pixels[rows]
    extents = [_extent(local[rows, axis], weight) for axis in range(3)]
    axis = int(np.argmax([high - low for low, high in extents]))
    first = count // 2
    plane = _quantile(local[rows, axis], weight, first / count)
    upper, lower = cell.upper.copy(), cell.lower.copy()
    upper[axis] = lower[axis] = plane
    below = local[rows, axis] < plane
    return [
        *_divide(_Cell(cell.lower, upper, rows[below]), first, local, pixels),
        *_divide(_Cell(lower, cell.upper, rows[~below]), count - first, local, pixels),
    ]


def _margins(cell: _Cell, local: Array, pixels: Array, reach: Array) -> tuple[Array, Array]:
    """(3,) distances by which the training region extends beyond the lower and upper faces."""
    below, above = np.zeros(3), np.zeros(3)
    for axis in range(3):
        low, high = _extent(local[:, axis], pixels)
        extent = high - low
        for face, margin in ((cell.lower[axis], below), (cell.upper[axis], above)):
            if not np.isfinite(face):
                continue
            near = np.abs(local[:, axis] - face) < MAX_MARGIN * extent
            measured = _quantile(reach[near], pixels[near], MARGIN_SHARE) if near.any() else 0.0
            margin[axis] = np.clip(measured, MIN_MARGIN * extent, MAX_MARGIN * extent)
    return below, above


def _bounds(views: Sequence[View], whole: Box, local: Array, pixels: Array) -> tuple[Array, Array]:
    """(3,) lower and upper bounds of the scene along its axes: those of the cameras and of its
    extent, with ``FAR_SHARE`` of their distance on both sides."""
    centres = whole.along_axes(np.stack([view.centre for view in views]))
    low, high = np.array([_extent(local[:, axis], pixels) for axis in range(3)]).T
    low, high = np.minimum(low, centres.min(0)), np.maximum(high, centres.max(0))
    return low - FAR_SHARE * (high - low), high + FAR_SHARE * (high - low)


def _extent(values: Array, weight: Array) -> tuple[float, float]:
    low, high = EXTENT_QUANTILES
    return _quantile(values, weight, low), _quantile(values, weight, high)


def _quantile(values: Array, weight: Array, share: float) -> float:
    """The weighted quantile: a value of which ``share`` of the weight is below."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    at = int(np.searchsorted(total, share * total[-1]))
    return float(values[order[min(at, len(order) - 1)]])


def _window(shown: NDArray[np.bool_], view: View) -> tuple[int, int, int, int]:
    """Left, top, width and height, pixels of the view, around these pixels of a reduced image."""
    left, width = _span(np.any(shown, 0), view.width)
    top, height = _span(np.any(shown, 1), view.height)
    return left, top, width, height


def _span(shown: Any, size: int) -> tuple[int, int]:
    found = np.flatnonzero(shown)
    scale = size / len(shown)
    begin = int(found[0] * scale) - WINDOW_MARGIN
    end = int(np.ceil((found[-1] + 1) * scale)) + WINDOW_MARGIN
    length = min(size, -(-(end - begin) // WINDOW_UNIT) * WINDOW_UNIT)
    return max(0, min((begin + end - length) // 2, size - length)), length
