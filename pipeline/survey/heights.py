"""A surface model (DSM): for each cell of a grid, the height of the highest surface that enough
points confirm.

Points above each other are separate surfaces if a gap is between their heights. The surface is
chosen in blocks of 3 x 3 cells, so that wrong points above or below it are left out; the height of
a cell is the median of its points on the surface. Small holes are interpolated, and a median over
3 x 3 cells removes noise without moving edges.
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
# A surface needs so many points in a block of cells, and this share of the points of the block's
# largest surface: a layer that only a few photographs have is not the surface.
BLOCK, MIN_POINTS, MIN_SHARE = 3, 3, 0.75
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
            # The neighbours of a cell, and what they are interpolated from.
            margin = FILL_CELLS + 1
            first, last = max(top - margin, 0), min(bottom + margin, self.grid.height)
            known = smoothed(filled(self._rows(first, last)))
            yield known[top - first : bottom - first]

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
        # The median, so that thinly covered borders do not count.
        if np.median(counts) >= POINTS_PER_CELL * BLOCK**2 or len(blocks) == 1:
            break
        factor *= 2
    return factor


def on_surface(points: Array, grid: Grid, gap: float) -> NDArray[np.bool_]:
    """(N,) whether each of (N, 3) map points is on the surface of its block of cells.

    Args:
        gap: The distance between surfaces in the unit of heights.
    """
    key = _cell_numbers(points, grid, BLOCK)
    order = np.lexsort((-points[:, 2], key))
    ordered_key, z = key[order], points[order, 2]
    new = np.ones(len(order), bool)
    new[1:] = (ordered_key[1:] != ordered_key[:-1]) | (z[:-1] - z[1:] > gap)
    start = np.flatnonzero(new)
    size = np.diff(np.append(start, len(order)))
    first = np.flatnonzero(np.append(True, np.diff(ordered_key[start]) != 0))
    largest = np.maximum.reduceat(size, first)
    of_block = np.cumsum(np.isin(np.arange(len(start)), first)) - 1
    good = np.flatnonzero((size >= MIN_POINTS) & (size >= MIN_SHARE * largest[of_block]))
    # Surfaces of a block are ordered from high to low.
    _, highest = np.unique(of_block[good], return_index=True)
    chosen = np.zeros(len(start), bool)
    chosen[good[highest]] = True
    found = np.empty(len(points), bool)
    found[order] = np.repeat(chosen, size)
    return found


def cell_heights(points: Array, grid: Grid) -> CellHeights:
    """The median height of the points in each cell that has some.

    Args:
        points: (N, 3) map points, which ``on_surface`` has chosen.
    """
    key = _cell_numbers(points, grid, 1)
    order = np.lexsort((points[:, 2], key))
    cells, first, count = np.unique(key[order], return_index=True, return_counts=True)
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


def smoothed(heights: Heights) -> Heights:
    """Each known height replaced by the median of the known ones in 3 x 3 cells."""
    rows, width = heights.shape
    # Unknown heights are infinite, so that they are last in the order.
    around = np.pad(np.where(heights == NODATA, np.inf, heights), 1, constant_values=np.inf)
    nine = [around[y : y + rows, x : x + width] for y in range(3) for x in range(3)]
    ordered = np.sort(np.stack(nine), axis=0)
    count = np.maximum(np.isfinite(ordered).sum(0), 1)[None]
    lower, upper = (
        np.take_along_axis(ordered, index, 0)[0] for index in ((count - 1) // 2, count // 2)
    )
    return np.where(heights == NODATA, heights, (lower + upper) / 2).astype(np.float32)


def _cell_numbers(points: Array, grid: Grid, block: int) -> NDArray[np.int64]:
    """(N,) the number of the cell, or block of cells, of each point."""
    row, column = (np.floor(values / block).astype(np.int64) for values in grid.cells_of(points))
    width = -(-grid.width // block)
    return np.asarray(
        np.clip(row, 0, -(-grid.height // block) - 1) * width + np.clip(column, 0, width - 1)
    )
