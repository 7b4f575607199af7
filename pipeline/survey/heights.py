"""A surface model (DSM): for each cell of a grid, the height of the highest surface that enough
points confirm.

Points above each other are separate surfaces if a gap is between their heights. Support is counted
in blocks of 3 x 3 cells, so that single wrong points above or below a surface are left out; the
height of a cell is the median of its highest supported surface. Small holes are interpolated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.io.geotiff import NODATA, TILE
from pipeline.survey.grid import Grid

Array = NDArray[np.float64]
Heights = NDArray[np.float32]

# Surfaces above each other are separate from this distance, in cells.
GAP_CELLS = 4.0
# A surface needs so many points in a block of cells, and this share of all its points.
BLOCK, MIN_POINTS, MIN_SHARE = 3, 3, 0.1
# The grid is made coarser until covered blocks have so many points per cell.
POINTS_PER_CELL = 0.8
# A hole is filled from known cells up to this far away, if there are some in this many of the eight
# directions: cells beside the covered area stay unknown.
FILL_CELLS, FILL_DIRECTIONS = 8, 5
_DIRECTIONS = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]


@dataclass(frozen=True)
class CellHeights:
    """The cells whose height is known, by rows and in a row by columns.

    Attributes:
        grid: The grid.
        cells: (M,) int64 ascending: row * grid.width + column.
        heights: (M,) float32.
    """

    grid: Grid
    cells: NDArray[np.int64]
    heights: Heights

    def strips(self) -> Iterator[Heights]:
        """(R, W) heights with filled holes, ``TILE`` rows at a time; ``NODATA`` where unknown."""
        for top in range(0, self.grid.height, TILE):
            bottom = min(top + TILE, self.grid.height)
            first, last = max(top - FILL_CELLS, 0), min(bottom + FILL_CELLS, self.grid.height)
            known = self._rows(first, last)
            yield filled(known)[top - first : top - first + bottom - top]

    def _rows(self, first: int, last: int) -> Heights:
        width = self.grid.width
        begin, end = np.searchsorted(self.cells, [first * width, last * width])
        strip = np.full((last - first) * width, NODATA, np.float32)
        strip[self.cells[begin:end] - first * width] = self.heights[begin:end]
        return strip.reshape(-1, width)


def factor_for(points: Array, grid: Grid) -> int:
    """How many times coarser than ``grid`` the cells have to be for the points' density: a power of
    two."""
    factor = 1
    while factor < 1024:
        cells = _cell_numbers(points, grid.coarser(factor), BLOCK)
        blocks, counts = np.unique(cells, return_counts=True)
        # Of half of the points, so that thinly covered borders do not count.
        if np.median(counts) >= POINTS_PER_CELL * BLOCK**2 or len(blocks) == 1:
            break
        factor *= 2
    return factor


def supported(points: Array, grid: Grid, gap: float) -> NDArray[np.bool_]:
    """(N,) whether each of (N, 3) map points is on a surface that enough points confirm."""
    order, start, size = _surfaces(_cell_numbers(points, grid, BLOCK), points[:, 2], gap)
    block = _cell_numbers(points, grid, BLOCK)[order[start]]
    _, member, total = np.unique(block, return_inverse=True, return_counts=True)
    points_of_block = np.bincount(member, weights=size, minlength=len(total))[member]
    good = (size >= MIN_POINTS) & (size >= MIN_SHARE * points_of_block)
    found = np.empty(len(points), bool)
    found[order] = np.repeat(good, size)
    return found


def cell_heights(points: Array, grid: Grid, gap: float) -> CellHeights:
    """The median height of the highest surface in each cell with points.

    Args:
        points: (N, 3) map points, which ``supported`` has chosen.
        gap: The distance between surfaces in the unit of heights.
    """
    numbers = _cell_numbers(points, grid, 1)
    order, start, size = _surfaces(numbers, points[:, 2], gap)
    cells, highest = np.unique(numbers[order[start]], return_index=True)
    first, count = start[highest], size[highest]
    z = points[order, 2]
    median = (z[first + (count - 1) // 2] + z[first + count // 2]) / 2
    return CellHeights(grid, cells, median.astype(np.float32))


def filled(heights: Heights) -> Heights:
    """The heights with small holes interpolated: the mean of the nearest known cells in eight
    directions, weighted by inverse distance."""
    rows, width = heights.shape
    around = np.pad(heights, FILL_CELLS, constant_values=NODATA)
    total, weights = np.zeros(heights.shape), np.zeros(heights.shape)
    directions = np.zeros(heights.shape, np.int8)
    for y, x in _DIRECTIONS:
        open_ = heights == NODATA
        for step in range(1, FILL_CELLS + 1):
            top, left = FILL_CELLS + step * y, FILL_CELLS + step * x
            value = around[top : top + rows, left : left + width]
            found = open_ & (value != NODATA)
            weight = np.where(found, 1 / (step * np.hypot(y, x)), 0)
            total += weight * value
            weights += weight
            directions += found
            open_ &= ~found
    enough = (heights == NODATA) & (directions >= FILL_DIRECTIONS)
    mean = total / np.where(weights > 0, weights, 1)
    return np.where(enough, mean, heights).astype(np.float32)


def _cell_numbers(points: Array, grid: Grid, block: int) -> NDArray[np.int64]:
    """(N,) the number of the cell, or block of cells, of each point."""
    row, column = (np.floor(values / block).astype(np.int64) for values in grid.cells_of(points))
    width = -(-grid.width // block)
    return np.asarray(
        np.clip(row, 0, -(-grid.height // block) - 1) * width + np.clip(column, 0, width - 1)
    )


def _surfaces(
    key: NDArray[np.int64], heights: Array, gap: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """The points ordered by key, those of a key from high to low, and for each run without a gap
    its start in this order and its number of points."""
    order = np.lexsort((-heights, key))
    ordered_key, z = key[order], heights[order]
    new = np.ones(len(order), bool)
    new[1:] = (ordered_key[1:] != ordered_key[:-1]) | (z[:-1] - z[1:] > gap)
    start = np.flatnonzero(new)
    return order, start, np.diff(np.append(start, len(order)))
