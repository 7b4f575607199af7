"""Writes the town: a folder of photographs with exact ground truth, as that of the demo scene."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from benchmarks.town.layout import build
from benchmarks.town.paths import camera_path, cells_of
from benchmarks.town.view import Capture, capture, photograph
from pipeline.demo.cameras import LENSES, WIDE, lens
from pipeline.demo.output import (
    MAX_CHUNK,
    Pixels,
    Poses,
    in_processes,
    new_scene,
    pick_pixels,
    surface_points,
    transforms,
)
from pipeline.demo.render import rays
from pipeline.demo.sensor import srgb, to_bytes, write_picture
from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import write_model
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError
from pipeline.runtime.machine import usable_cores
from pipeline.runtime.progress import Progress
from pipeline.scene.reconstruction import PosedImage, Reconstruction

Order = Literal["sequence", "scattered"]

# Limits that bound the memory for the town's solids, and for the rays of a photograph.
MAX_PHOTOGRAPHS = 20_000
MIN_SIDE, MAX_SIDE = 16, 4096  # pixels
START = datetime(2026, 1, 1, 8)
# The time between photographs. Scattered ones are minutes apart, so that nothing takes them for a
# sequence.
INTERVALS = {"sequence": timedelta(seconds=2), "scattered": timedelta(minutes=1)}
LENS_CHOICES = tuple(name for name in LENSES if name not in WIDE and "fisheye" not in name)


@dataclass(frozen=True)
class TownSpec:
    """The options of the town.

    Attributes:
        photographs: The number of photographs, to which the town's area is proportional.
        width, height: The size in pixels.
        distortion: One of ``LENS_CHOICES``.
        order: The order of names and times: along the camera path, or "scattered" at random.
        poses: The poses given as an input: "none", "colmap" (sparse/0) or "transforms" (.json).
        seed: The seed of the town.
    """

    photographs: int = 60
    width: int = 640
    height: int = 427
    distortion: str = "simple_radial"
    order: Order = "sequence"
    poses: Poses = "none"
    seed: int = 0

    def check(self) -> None:
        """Raise UserError if an option is out of its range."""
        if not 1 <= self.photographs <= MAX_PHOTOGRAPHS:
            raise UserError(
                f"a town of {self.photographs} photographs", fix=f"1 to {MAX_PHOTOGRAPHS}."
            )
        sides = self.width, self.height
        if min(sides) < MIN_SIDE or max(sides) > MAX_SIDE:
            raise UserError(
                f"photographs of {self.width}x{self.height} pixels",
                fix=f"Sides of {MIN_SIDE} to {MAX_SIDE}.",
            )
        if self.distortion not in LENS_CHOICES:
            raise UserError(f"unknown lens {self.distortion!r}", fix=f"One of {[*LENS_CHOICES]}.")
        if self.order not in get_args(Order) or self.poses not in get_args(Poses):
            raise UserError(f"unknown order {self.order!r} or poses {self.poses!r}")
        if self.seed < 0:
            raise UserError(f"the seed {self.seed} is negative", fix="Choose 0 or more.")


def write_town(folder: Path, spec: TownSpec, processes: int | None = 1) -> None:
    """Write the town; the same spec writes the same bytes at any number of processes.

    Inside ``folder``: ``images/``; ``sparse_gt/`` (COLMAP text, the exact cameras of the stored
    pixels); ``depth_gt/*.npy`` (float32 z at pixel centres, 0 in the sky); ``sparse/0`` or
    ``transforms.json`` if asked for; ``town.json`` (the spec).

    Args:
        processes: The number of photographs rendered at once; None is one per core.

    Raises:
        UserError: Options are out of their range, or ``folder`` holds something else.
    """
    spec.check()
    with new_scene(folder, "town.json", "synthetic town") as work:
        (work / "images").mkdir()
        (work / "depth_gt").mkdir()
        _write(work, spec, processes or usable_cores())


def _write(folder: Path, spec: TownSpec, processes: int) -> None:
    progress = Progress("photographing the town", spec.photographs, "photographs")
    write = partial(_write_photograph, folder, spec)
    colours: dict[str, NDArray[np.uint8]] = {}
    with in_processes(write, spec.photographs, processes, MAX_CHUNK) as written:
        for name, colour in written:
            colours[name] = colour
            progress.advance()
    camera, views = _camera(spec), sorted(_views(spec), key=lambda posed: posed.name)
    truth = Reconstruction({1: camera}, {i + 1: posed for i, posed in enumerate(views)})
    write_model(folder / "sparse_gt", truth, text=True)
    if spec.poses == "colmap":
        points = surface_points(
            truth,
            _picks(spec),
            [colours[posed.name] for posed in views],
            lambda i: np.load(_depth_file(folder, views[i].name), mmap_mode="r"),
        )
        write_model(folder / "sparse" / "0", Reconstruction(truth.cameras, truth.images, points))
    if spec.poses == "transforms":
        write_json(folder / "transforms.json", transforms(camera, views))
    write_json(folder / "town.json", asdict(spec))


def _camera(spec: TownSpec) -> Camera:
    return lens(spec.distortion, spec.width, spec.height)


@lru_cache(maxsize=1)
def _views(spec: TownSpec) -> list[PosedImage]:
    """The cameras along the path, with their names."""
    return camera_path([f"town_{number:05d}.jpg" for number in _numbers(spec)], spec.seed)


@lru_cache(maxsize=1)
def _numbers(spec: TownSpec) -> list[int]:
    """The number in the name of each photograph along the path."""
    numbers = np.arange(spec.photographs)
    if spec.order == "scattered":
        numbers = np.random.default_rng([spec.seed, 14]).permutation(numbers)
    return [int(number) for number in numbers]


@lru_cache(maxsize=1)
def _capture(spec: TownSpec) -> Capture:
    """The town, built once per process."""
    camera = _camera(spec)
    return capture(build(cells_of(spec.photographs), spec.seed), camera, rays(camera))


def _depth_file(folder: Path, name: str) -> Path:
    return folder / "depth_gt" / f"{Path(name).stem}.npy"


def _write_photograph(folder: Path, spec: TownSpec, step: int) -> tuple[str, NDArray[np.uint8]]:
    """Write the photograph at a step of the path; returns its name and colours for its points."""
    posed, number = _views(spec)[step], _numbers(spec)[step]
    light, depth = photograph(_capture(spec), posed)
    colour = to_bytes(srgb(light))
    taken = START + number * INTERVALS[spec.order]
    write_picture(folder / "images" / posed.name, colour, f"{taken:%Y:%m:%d %H:%M:%S}")
    np.save(_depth_file(folder, posed.name), depth)
    columns, rows = _picks(spec)[number]
    return posed.name, colour[rows, columns]


@lru_cache(maxsize=1)
def _picks(spec: TownSpec) -> list[Pixels]:
    return pick_pixels(_camera(spec), spec.photographs, spec.seed)
