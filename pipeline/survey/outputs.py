"""The maps of a georeferenced scene: ``orthophoto.tif`` and ``dsm.tif``, ``dense_points.laz`` and
``accuracy.html``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray

from pipeline.config.export import Export
from pipeline.io.geotiff import TILE, write_geotiff
from pipeline.io.laz import write_laz
from pipeline.mvs.maps import DenseCloud, read_dense_cloud
from pipeline.runtime.errors import UserError
from pipeline.scene.exposure import ExposureGains
from pipeline.scene.georeference import Georeference
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View
from pipeline.survey.accuracy import Mapped, write_accuracy
from pipeline.survey.grid import (
    MAX_CELLS,
    Grid,
    grid_over,
    near_cameras,
    pixel_size_m,
    rounded_cell,
)
from pipeline.survey.heights import (
    GAP_CELLS,
    CellHeights,
    cell_heights,
    factor_for,
    on_surface,
)
from pipeline.survey.map_frame import MapFrame, map_frame
from pipeline.survey.orthophoto import Overlap, orthophoto_strips, photos_of

Array = NDArray[np.float64]

ORTHOPHOTO, SURFACE, CLOUD = "orthophoto.tif", "dsm.tif", "dense_points.laz"


@dataclass(frozen=True)
class SurveyScene:
    """A scene to map; its unit is the metre and its z axis points up.

    Attributes:
        views: The views at the size of the photographs.
        training_views: The same views at the size of training, which the depth maps have.
        model: The cameras and sparse points.
        georeference: The frame of the poses, which has a place on the earth.
        gains: The light of each view.
        dense: The folder of the dense stage.
    """

    views: Sequence[View]
    training_views: Sequence[View]
    model: Reconstruction
    georeference: Georeference
    gains: ExposureGains
    dense: Path


@dataclass(frozen=True)
class Messages:
    """Messages to the user about the maps."""

    decisions: list[str]
    warnings: list[str]


def write_survey(out: Path, scene: SurveyScene, config: Export, threads: int) -> Messages:
    """Write the files that ``config.formats`` names, and ``accuracy.html``.

    Memory: some hundred bytes for each point of the dense cloud (of which there are at most five
    million), ``orthophoto.CACHED_PHOTOS`` photographs, and a few strips of ``TILE`` rows of the
    map, whose whole surface model is in a temporary file.

    Raises:
        UserError: The map has no east and north (``map_frame``), or the dense cloud no surface.
    """
    frame = map_frame(scene.georeference)
    messages = Messages([], [])
    if not frame.has_altitude:
        messages.warnings.append(
            "the photographs have no altitudes: heights of the maps are relative to the cameras"
        )
    cloud = read_dense_cloud(scene.dense)
    xyz = cloud.xyz.astype(np.float64)
    points = frame.to_map(xyz)
    if "laz" in config.formats:
        normals = _map_normals(frame, cloud, points)
        write_laz(out / CLOUD, points, cloud.rgb, normals, frame.crs)
    training = [view for view in scene.training_views if not view.is_test]
    pixel = pixel_size_m(training, scene.model)
    mapped = Mapped(frame, pixel)
    if "ortho" in config.formats:
        cell_m = config.ground_sampling_m or rounded_cell(pixel)
        near = near_cameras(xyz, training, max(cell_m, pixel))
        mapped = _write_maps(out, scene, frame, points[near], cell_m, mapped, messages, threads)
    write_accuracy(out, mapped, scene.model, scene.georeference)
    messages.decisions.append(f"maps in {frame.name}")
    return messages


def _write_maps(
    out: Path,
    scene: SurveyScene,
    frame: MapFrame,
    points: Array,
    cell_m: float,
    mapped: Mapped,
    messages: Messages,
    threads: int,
) -> Mapped:
    """Write the surface model and the orthophoto."""
    grid, heights = _surface(frame, points, cell_m, messages)
    views = [view for view in scene.views if not view.is_test]
    full_pixel = pixel_size_m(views, scene.model)
    photos = photos_of(views, scene.dense, scene.gains, grid.cell * frame.unit / full_pixel)
    overlap = Overlap()
    shape = heights.grid.height, heights.grid.width
    with TemporaryFile(dir=out) as file:
        surface = np.memmap(file, np.float32, "w+", shape=shape)
        strips = _stored(heights, surface)
        place = heights.grid.placed(frame)
        write_geotiff(out / SURFACE, strips, shape[1], shape[0], place)
        colours = orthophoto_strips(photos, frame, grid, surface, heights.grid, overlap, threads)
        write_geotiff(out / ORTHOPHOTO, colours, grid.width, grid.height, grid.placed(frame))
        del surface
    cell, surface_cell = grid.cell * frame.unit, heights.grid.cell * frame.unit
    messages.decisions.append(
        f"orthophoto: {grid.width}x{grid.height} cells of {cell:.4g} m, heights in cells of "
        f"{surface_cell:.4g} m; {overlap.mean:.1f} photographs per cell"
    )
    return replace(
        mapped,
        cell_m=cell,
        surface_cell_m=surface_cell,
        area_m2=overlap.cells * cell**2,
        overlap=overlap.mean,
    )


def _surface(
    frame: MapFrame, points: Array, cell_m: float, messages: Messages
) -> tuple[Grid, CellHeights]:
    """The grid of the map, and the heights of the cells of one that is as fine or coarser."""
    empty = UserError(
        "expected surfaces in the dense cloud for the maps, found none",
        fix="take photographs with more overlap, or leave ortho out of export.formats",
    )
    if not len(points):
        raise empty
    wanted = cell_m
    while (grid := grid_over(points, cell_m / frame.unit)).width * grid.height > MAX_CELLS:
        cell_m *= 2
    if cell_m > wanted:
        messages.warnings.append(
            f"a map of the whole scene with cells of {wanted:.4g} m would be too large: used "
            f"{cell_m:.4g} m (export.ground_sampling_m)"
        )
    coarse = grid.coarser(factor_for(points, grid))
    gap = GAP_CELLS * coarse.cell * frame.unit / frame.height_unit
    points = points[on_surface(points, coarse, gap)]
    if not len(points):
        raise empty
    # The grid again: points far from all others are gone.
    factor = round(coarse.cell / grid.cell)
    coarse = grid_over(points, coarse.cell)
    grid = Grid(coarse.west, coarse.north, grid.cell, coarse.width * factor, coarse.height * factor)
    return grid, cell_heights(points, coarse)


def _stored(heights: CellHeights, surface: NDArray[np.float32]) -> Iterator[NDArray[np.float32]]:
    """The strips of the heights, each after it has been written into ``surface``."""
    for number, strip in enumerate(heights.strips()):
        surface[number * TILE : number * TILE + len(strip)] = strip
        yield strip


def _map_normals(frame: MapFrame, cloud: DenseCloud, points: Array) -> NDArray[np.float32]:
    """(N, 3) the normals of the cloud in the axes of the map."""
    units = [frame.unit, frame.unit, frame.height_unit]
    ends = frame.to_map(cloud.xyz.astype(np.float64) + cloud.normals)
    along = (ends - points) * units
    length = np.linalg.norm(along, axis=1, keepdims=True)
    return np.asarray(along / np.maximum(length, 1e-12), np.float32)
