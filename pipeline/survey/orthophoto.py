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
from pipeline.mvs.maps import read_map
from pipeline.photos.load import load_view
from pipeline.photos.threads import one_thread_of_opencv
from pipeline.runtime.progress import track
from pipeline.scene.exposure import ExposureGains
from pipeline.scene.views import View, resized
from pipeline.survey.grid import Grid
from pipeline.survey.map_frame import MapFrame

Array = NDArray[np.float64]

# Photographs in memory at a time.
CACHED_PHOTOS = 12
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


@dataclass(frozen=True)
class Photo:
    """A photograph of the map.

    Attributes:
        view: Its camera, at the size of ``rgb``.
        rgb: (H, W, 3) uint8, in the scene's typical light.
        valid: (H, W) bool, False for what masks and alpha exclude; None if everything is valid.
        depth: (h, w) float32 camera z over the same view, 0 where unknown.
    """

    view: View
    rgb: NDArray[np.uint8]
    valid: NDArray[np.bool_] | None
    depth: NDArray[np.float32]


@dataclass(frozen=True)
class Photos:
    """The photographs of a map, which are read when they are needed.

    Attributes:
        views: The cameras at the size to read.
        read: Returns a photograph by its index.
    """

    views: Sequence[View]
    read: Callable[[int], Photo]


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
    def read(index: int) -> Photo:
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
        return Photo(view, rgb, valid, read_map(dense, view.name).depth)

    return Photos(chosen, read)


@dataclass
class Overlap:
    """How many photographs see the cells of the map.

    Attributes:
        cells: The number of cells with colours.
        photos: The sum over them of the number of photographs.
    """

    cells: int = 0
    photos: int = 0

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

            def tile(left: int, top: int = top, rows: int = rows) -> tuple[NDArray, int]:
                size = rows, min(TILE, grid.width - left)
                points = _points(grid, surface, surface_grid, top, left, size)
                return _coloured(photos, frame, points, size, grid.cell * frame.unit)

            tiles = list(pool.map(tile, range(0, grid.width, TILE)))
            strip = np.concatenate([colours for colours, _ in tiles], axis=1)
            overlap.cells += int((strip[..., 3] > 0).sum())
            overlap.photos += sum(count for _, count in tiles)
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
) -> tuple[NDArray[np.uint8], int]:
    """(R, C, 4) RGBA of a tile, and the sum over its cells of the photographs that show them."""
    result = np.zeros((len(points), 4), np.uint8)
    known = np.flatnonzero(np.isfinite(points[:, 2]))
    if not len(known):
        return result.reshape(*size, 4), 0
    xyz = frame.to_scene(points[known])
    chosen = _most_vertical(photos.views, xyz[:: min(_SAMPLED, len(xyz))])
    costs = np.full((len(chosen), len(xyz)), np.float32(_TOO_FAR))
    for place, index in enumerate(chosen):
        costs[place] = _cost(photos.read(index), xyz, cell_m)
    if not len(chosen):
        return result.reshape(*size, 4), 0
    best = costs.min(0)
    shown = best < _TOO_FAR
    weights = np.where(costs < _TOO_FAR, np.exp((best - costs) / BLENDING), 0)
    weights[weights < 0.01] = 0
    total = np.zeros((len(xyz), 3))
    for place, index in enumerate(chosen):
        where = np.flatnonzero(weights[place])
        if len(where):
            photo = photos.read(index)
            total[where] += weights[place, where, None] * _colours(photo, xyz[where])
    mean = total / np.maximum(weights.sum(0), 1e-9)[:, None]
    result[known, :3] = np.where(shown[:, None], np.rint(mean), 0)
    result[known, 3] = np.where(shown, 255, 0)
    return result.reshape(*size, 4), int((costs < _TOO_FAR).sum())


def _most_vertical(views: Sequence[View], xyz: Array) -> list[int]:
    """The views that show some of the points, those that look most vertically first."""
    found = []
    for index, view in enumerate(views):
        x, y, z = _projected(view, xyz)
        inside = (z > 0) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
        if inside.any():
            found.append((float(np.median(_tangent(view, xyz[inside]))), index))
    return [index for _, index in sorted(found)[:MAX_PHOTOS_PER_TILE]]


def _cost(photo: Photo, xyz: Array, cell_m: float) -> NDArray[np.float32]:
    """(N,) what it costs to show each point by this photograph: the tangent of the angle to the
    vertical, and more at the photograph's edge and where its depth is unknown; ``_TOO_FAR`` where
    it does not show the point."""
    view = photo.view
    x, y, z = _projected(view, xyz)
    shows = (z > 0) & (x >= 0.5) & (x < view.width - 0.5) & (y >= 0.5) & (y < view.height - 0.5)
    u, v = np.where(shows, x, 0), np.where(shows, y, 0)
    if photo.valid is not None:
        shows &= photo.valid[v.astype(int), u.astype(int)]
    rows, columns = photo.depth.shape
    depth = photo.depth[
        (v * (rows / view.height)).astype(int), (u * (columns / view.width)).astype(int)
    ]
    shows &= (depth == 0) | (z - depth < NEARER_CELLS * cell_m + NEARER_SHARE * z)
    to_edge = np.minimum.reduce([u, view.width - u, v, view.height - v]) / (BORDER * view.width)
    cost = _tangent(view, xyz) + EDGE * (1 - to_edge.clip(0, 1)) + UNKNOWN_DEPTH * (depth == 0)
    return np.where(shows, cost, _TOO_FAR).astype(np.float32)


def _colours(photo: Photo, xyz: Array) -> NDArray[np.float32]:
    """(N, 3) the photograph's colours at points that it shows, bilinear."""
    x, y, _ = _projected(photo.view, xyz)
    # OpenCV's pixel centres are integers, and it takes no more than 32767 rows.
    side = math.ceil(math.sqrt(len(x)))
    places = np.zeros((2, side * side), np.float32)
    places[0, : len(x)], places[1, : len(x)] = x - 0.5, y - 0.5
    maps = places.reshape(2, side, side)
    found = cv2.remap(
        photo.rgb, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(found.reshape(-1, 3)[: len(x)], np.float32)


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
