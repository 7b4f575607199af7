"""The orthophoto: photographs projected onto the surface model, with their light made equal.

Each cell shows the photographs that look at it most vertically, among those in which nothing is in
front of it. Where two are equally good they are blended, so that seams are not visible. What is in
front of what follows from the depth maps of multi-view stereo.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.io.geotiff import NODATA, TILE
from pipeline.mvs.maps import read_depth_of_map
from pipeline.photos.load import load_view
from pipeline.photos.threads import one_thread_of_opencv
from pipeline.runtime.progress import track
from pipeline.scene.exposure import ExposureGains
from pipeline.scene.views import View, resized
from pipeline.survey.grid import Grid
from pipeline.survey.map_frame import MapFrame

Array = NDArray[np.float64]

# Photographs, and depth maps at the size of training, in memory at a time.
CACHED_PHOTOS, CACHED_DEPTHS = 12, 48
# Photographs that a tile of the map is made of at most: the most vertical ones.
MAX_PHOTOS_PER_TILE = 32
# Photographs are blended where the tangents of their angles to the vertical differ by about this.
BLENDING = 0.02
# A photograph's border, as a share of its width, counts less and less towards the edge.
BORDER = 0.05
# What an unknown depth and the edge of a photograph cost, as tangents.
UNKNOWN_DEPTH, EDGE = 0.3, 1.0
# Something is in front of a cell if a photograph's depth is less by so many cells and this share.
NEARER_CELLS, NEARER_SHARE = 4.0, 0.005
# Every so many cells of a tile are projected to choose photographs.
_SAMPLED = 61
_TOO_FAR = 1e9
_SMALL_WEIGHT = 0.01


@dataclass(frozen=True)
class Photo:
    """The pixels of a photograph.

    Attributes:
        rgb: (H, W, 3) uint8, in the scene's typical light.
        valid: (H, W) uint8, 0 for what masks and alpha exclude; None if everything is valid.
    """

    rgb: NDArray[np.uint8]
    valid: NDArray[np.uint8] | None


@dataclass(frozen=True)
class Photos:
    """The photographs of a map, which are read when they are needed.

    Attributes:
        views: The cameras at the size to read.
        photo: Returns the pixels of a view by its index.
        depth: Returns the depth map of a view by its index: (h, w) float32 camera z over the whole
            view, 0 where unknown.
    """

    views: Sequence[View]
    photo: Callable[[int], Photo]
    depth: Callable[[int], NDArray[np.float32]]


def photos_of(
    views: Sequence[View], dense: Path, gains: ExposureGains, pixels_per_cell: float
) -> Photos:
    """The photographs of views with a depth map.

    Args:
        views: The views at the size of the files.
        dense: The folder of the dense stage.
        gains: The light of each view.
        pixels_per_cell: How many pixels a cell is wide, in the typical view: larger photographs are
            reduced, so that a cell shows the mean of its pixels.
    """
    factor = max(pixels_per_cell, 1.0)
    chosen = [
        resized(view, max(1, round(view.width / factor)), max(1, round(view.height / factor)))
        for view in views
    ]

    @lru_cache(CACHED_PHOTOS)
    def photo(index: int) -> Photo:
        view = chosen[index]
        pixels = load_view(view)
        rgb, light = pixels.rgb, gains.of(view.name)
        if light is not None:
            equal = pixels.rgb / light.factor(view)
            rgb = np.rint(equal.clip(0, 255)).astype(np.uint8)
        valid = pixels.mask
        if pixels.alpha is not None:
            opaque = pixels.alpha == 255
            valid = opaque if valid is None else valid & opaque
        return Photo(rgb, None if valid is None else valid.astype(np.uint8))

    @lru_cache(CACHED_DEPTHS)
    def depth(index: int) -> NDArray[np.float32]:
        return read_depth_of_map(dense, chosen[index].name)

    return Photos(chosen, photo, depth)


@dataclass
class Overlap:
    """How many photographs see the cells of the map.

    Attributes:
        cells: The number of cells with colours.
        photos: The sum over them of the number of photographs whose frame has the cell, whatever
            may be in front of it.
    """

    cells: int = 0
    photos: float = 0.0

    @property
    def mean(self) -> float:
        return self.photos / max(self.cells, 1)


def orthophoto_strips(
    photos: Photos,
    frame: MapFrame,
    grid: Grid,
    surface: NDArray[np.float32],
    surface_grid: Grid,
    overlap: Overlap,
    threads: int,
) -> Iterator[NDArray[np.uint8]]:
    """(R, W, 4) RGBA, ``TILE`` rows at a time from the north. The alpha of cells that no photograph
    shows is 0.

    Args:
        surface: (H, W) heights on ``surface_grid`` in the map's unit, ``NODATA`` where unknown.
            Only the rows of a strip are read at a time.
        overlap: What is counted while the strips are made.
    """
    tops = range(0, grid.height, TILE)
    with one_thread_of_opencv(), ThreadPoolExecutor(max(threads, 1)) as pool:
        for top in track(tops, "orthophoto", len(tops), unit="strips"):
            rows = min(TILE, grid.height - top)

            def tile(left: int, top: int = top, rows: int = rows) -> tuple[NDArray, float]:
                size = rows, min(TILE, grid.width - left)
                points = _points(grid, surface, surface_grid, top, left, size)
                return _coloured(photos, frame, points, size, grid.cell * frame.unit)

            tiles = list(pool.map(tile, range(0, grid.width, TILE)))
            strip = np.concatenate([colours for colours, _ in tiles], axis=1)
            for colours, photos_per_cell in tiles:
                cells = int((colours[..., 3] > 0).sum())
                overlap.cells += cells
                overlap.photos += photos_per_cell * cells
            yield strip


def _points(
    grid: Grid,
    surface: NDArray[np.float32],
    surface_grid: Grid,
    top: int,
    left: int,
    size: tuple[int, int],
) -> Array:
    """(R * C, 3) map points of a tile's cells; the height is NaN where it is unknown."""
    rows, columns = np.mgrid[top : top + size[0], left : left + size[1]]
    places = grid.centres(rows.ravel(), columns.ravel())
    return np.column_stack([places, height_at(places, surface, surface_grid)])


def height_at(places: Array, surface: NDArray[np.float32], grid: Grid) -> Array:
    """(N,) heights at (N, 2) places, bilinear; beside unknown cells that of the nearest cell, NaN
    where that is unknown."""
    row, column = grid.cells_of(places)
    y0, x0 = np.floor(row - 0.5).astype(int), np.floor(column - 0.5).astype(int)
    fy, fx = row - 0.5 - y0, column - 0.5 - x0
    first = int(np.clip(y0.min(), 0, grid.height - 1))
    part = np.asarray(surface[first : int(np.clip(y0.max() + 1, 0, grid.height - 1)) + 1])

    def at(y: NDArray[np.intp], x: NDArray[np.intp]) -> Array:
        inside_y, inside_x = np.clip(y, 0, grid.height - 1), np.clip(x, 0, grid.width - 1)
        values = part[inside_y - first, inside_x].astype(np.float64)
        return np.where(values == NODATA, np.nan, values)

    upper = at(y0, x0) * (1 - fx) + at(y0, x0 + 1) * fx
    lower = at(y0 + 1, x0) * (1 - fx) + at(y0 + 1, x0 + 1) * fx
    mean = upper * (1 - fy) + lower * fy
    nearest = at(np.floor(row).astype(int), np.floor(column).astype(int))
    return np.where(np.isfinite(mean), mean, nearest)


def _coloured(
    photos: Photos, frame: MapFrame, points: Array, size: tuple[int, int], cell_m: float
) -> tuple[NDArray[np.uint8], float]:
    """(R, C, 4) RGBA of a tile, and the mean number of photographs whose frame has a cell."""
    result = np.zeros((len(points), 4), np.uint8)
    known = np.flatnonzero(np.isfinite(points[:, 2]))
    if not len(known):
        return result.reshape(*size, 4), 0.0
    xyz = frame.to_scene(points[known])
    chosen, overlap = _most_vertical(photos.views, xyz[:: min(_SAMPLED, len(xyz))])
    if not chosen:
        return result.reshape(*size, 4), 0.0
    costs = np.stack([_cost(photos, index, xyz, cell_m) for index in chosen])
    best = costs.min(0)
    weights = np.where(costs < _TOO_FAR, np.exp((best - costs) / BLENDING), 0)
    weights[weights < _SMALL_WEIGHT] = 0
    light, total = np.zeros((len(xyz), 3)), np.zeros(len(xyz))
    for place, index in enumerate(chosen):
        where = np.flatnonzero(weights[place])
        if len(where):
            colours, valid = _colours(photos, index, xyz[where])
            weight = weights[place, where] * valid
            light[where] += weight[:, None] * colours
            total[where] += weight
    shown = total > 0
    result[known[shown], :3] = np.rint(light[shown] / total[shown, None])
    result[known[shown], 3] = 255
    return result.reshape(*size, 4), overlap


def _most_vertical(views: Sequence[View], xyz: Array) -> tuple[list[int], float]:
    """The views whose frames have some of the points, those that look most vertically first, and
    the mean number of views whose frame has a point."""
    found, number = [], 0
    for index, view in enumerate(views):
        x, y, z = _projected(view, xyz)
        inside = (z > 0) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
        if inside.any():
            number += int(inside.sum())
            found.append((float(np.median(_tangent(view, xyz[inside]))), index))
    return [index for _, index in sorted(found)[:MAX_PHOTOS_PER_TILE]], number / len(xyz)


def _cost(photos: Photos, index: int, xyz: Array, cell_m: float) -> NDArray[np.float32]:
    """(N,) what it costs to show each point by a photograph: the tangent of the angle to the
    vertical, and more at the photograph's edge and where its depth is unknown; ``_TOO_FAR`` where
    it does not show the point."""
    view, map_ = photos.views[index], photos.depth(index)
    cost = np.full(len(xyz), np.float32(_TOO_FAR))
    x, y, z = _projected(view, xyz)
    inside = (z > 0) & (x >= 0.5) & (x < view.width - 0.5) & (y >= 0.5) & (y < view.height - 0.5)
    where = np.flatnonzero(inside)
    x, y, z = x[where], y[where], z[where]
    rows, columns = map_.shape
    depth = map_[(y * (rows / view.height)).astype(int), (x * (columns / view.width)).astype(int)]
    hidden = (depth > 0) & (z - depth > NEARER_CELLS * cell_m + NEARER_SHARE * z)
    to_edge = np.minimum.reduce([x, view.width - x, y, view.height - y]) / (BORDER * view.width)
    found = _tangent(view, xyz[where]) + EDGE * (1 - to_edge.clip(0, 1))
    cost[where] = np.where(hidden, _TOO_FAR, found + UNKNOWN_DEPTH * (depth == 0))
    return cost


def _colours(
    photos: Photos, index: int, xyz: Array
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(N, 3) the photograph's colours at points in its frame, bilinear, and (N,) whether these
    pixels are valid."""
    photo = photos.photo(index)
    x, y, _ = _projected(photos.views[index], xyz)
    # OpenCV's pixel centres are integers, and it takes no more than 32767 rows.
    side = math.ceil(math.sqrt(len(x)))
    places = np.zeros((2, side * side), np.float32)
    places[0, : len(x)], places[1, : len(x)] = x - 0.5, y - 0.5
    columns, rows = places.reshape(2, side, side)

    def sampled(picture: NDArray[np.uint8], method: int) -> NDArray:
        return cv2.remap(picture, columns, rows, method, borderMode=cv2.BORDER_REPLICATE)

    colours = sampled(photo.rgb, cv2.INTER_LINEAR).reshape(-1, 3)[: len(x)]
    if photo.valid is None:
        return colours.astype(np.float32), np.ones(len(x), bool)
    valid = sampled(photo.valid, cv2.INTER_NEAREST).ravel()[: len(x)]
    return colours.astype(np.float32), valid > 0


def _projected(view: View, xyz: Array) -> tuple[Array, Array, Array]:
    """(N,) x, y in pixels and camera z of points; 0 for those behind the camera."""
    local = np.einsum("ij,nj->ni", view.world_to_camera[:3, :3], xyz)
    x, y, z = (local + view.world_to_camera[:3, 3]).T
    front = np.where(z > 0, z, np.inf)
    return view.fx * x / front + view.cx, view.fy * y / front + view.cy, z


def _tangent(view: View, xyz: Array) -> Array:
    """(N,) the tangent of the angle between the vertical and the ray to the camera; large for
    cameras that are not above the point."""
    x, y, z = (view.centre - xyz).T
    return np.hypot(x, y) / np.maximum(z, 1e-6 * (1 + np.hypot(x, y)))
