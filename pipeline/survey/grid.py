"""The grid of a map: size of a cell, extent, and which points are on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.io.geotiff import Georeferenced
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View
from pipeline.survey.map_frame import MapFrame

Array = NDArray[np.float64]

# Bounds of the size of a cell that is measured, metres.
MIN_CELL_M, MAX_CELL_M = 0.001, 100.0
# The largest number of cells of a map: TIFF's offsets stay well below its limits, and a larger map
# is slow to make and to open.
MAX_CELLS = 2**31
# Surfaces whose finest pixel covers more than so many cells are not on the map: the horizon.
MAX_PIXEL_CELLS = 4.0


@dataclass(frozen=True)
class Grid:
    """Cells with north up.

    Attributes:
        west, north: The outer corner of the upper left cell, in the map's unit; a multiple of
            ``cell``.
        cell: The width and height of a cell in the map's unit.
        width, height: The number of columns and rows.
    """

    west: float
    north: float
    cell: float
    width: int
    height: int

    def placed(self, frame: MapFrame) -> Georeferenced:
        return Georeferenced(frame.crs, self.west, self.north, self.cell)

    def cells_of(self, points: Array) -> tuple[Array, Array]:
        """(N,) rows and columns of (N, 2 or 3) points, as fractions: 0.5 is the first centre."""
        return (self.north - points[:, 1]) / self.cell, (points[:, 0] - self.west) / self.cell

    def centres(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Array:
        """(N, 2) east and north of the centres of cells."""
        corner = np.array([self.west, self.north])
        return corner + self.cell * np.column_stack([columns + 0.5, -(rows + 0.5)])

    def coarser(self, factor: int) -> Grid:
        """A grid over the same place whose cells are ``factor`` times as wide."""
        width, height = -(-self.width // factor), -(-self.height // factor)
        return Grid(self.west, self.north, self.cell * factor, width, height)


def grid_over(points: Array, cell: float) -> Grid:
    """The smallest grid over (N, 2 or 3) points, N >= 1."""
    west, north = (
        math.floor(points[:, 0].min() / cell),
        math.floor(points[:, 1].max() / cell) + 1,
    )
    east, south = math.floor(points[:, 0].max() / cell) + 1, math.floor(points[:, 1].min() / cell)
    return Grid(west * cell, north * cell, cell, east - west, north - south)


def pixel_size_m(views: Sequence[View], model: Reconstruction) -> float:
    """The median over the views of the size of a pixel at the sparse points that they see, scene
    units; 0 if no view sees any."""
    sizes = []
    seen = model.observed_points(view.name for view in views)
    for view, points in zip(views, seen, strict=True):
        xyz = model.points.xyz[points]
        depth = xyz @ view.world_to_camera[2, :3] + view.world_to_camera[2, 3]
        if len(depth := depth[depth > 0]):
            sizes.append(float(np.median(depth)) / math.sqrt(view.fx * view.fy))
    return float(np.median(sizes)) if sizes else 0.0


def rounded_cell(size_m: float) -> float:
    """The size of a cell in metres: two significant digits, within the bounds."""
    return float(f"{min(max(size_m, MIN_CELL_M), MAX_CELL_M):.1e}")


def near_cameras(xyz: Array, views: Sequence[View], cell_m: float) -> NDArray[np.bool_]:
    """(N,) whether a camera is near enough to see each point with pixels of at most
    ``MAX_PIXEL_CELLS`` cells. Scene units are metres."""
    focal = min(math.sqrt(view.fx * view.fy) for view in views)
    tree = cKDTree(np.stack([view.centre for view in views]))
    distance, _ = tree.query(xyz, distance_upper_bound=MAX_PIXEL_CELLS * cell_m * focal)
    return np.asarray(np.isfinite(distance))
