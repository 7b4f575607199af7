"""Frames per second of rendering: projection, binning and blending, without gradients."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.raster.measure import BACKGROUND, MIN_TURNS, Spread
from benchmarks.raster.scenes import Scene
from pipeline.render import RasterOptions, make_backend


@dataclass(frozen=True)
class Drawing:
    """The milliseconds per frame, over rounds of all views: wall time, and CPU time over threads.

    Attributes:
        visible: The mean number of Gaussians that touch the image over the views.
        tile_pairs: The mean number of (Gaussian, tile) pairs over the views.
    """

    threads: int
    views: int
    wall: Spread
    cpu: Spread
    visible: float
    tile_pairs: float

    def __str__(self) -> str:
        return (
            f"{self.threads:8} {1e3 / self.wall.median:9.2f} {self.wall.median:9.2f} "
            f"{f'{self.wall.low:.2f} to {self.wall.high:.2f}':>17} {self.cpu.median:9.2f}"
        )


HEADER = f"{'threads':>8} {'frames/s':>9} {'ms':>9} {'quartiles':>17} {'CPU ms':>9}"


def drawings(scene: Scene, threads: Sequence[int], seconds: float) -> list[Drawing]:
    """Measure the numbers of threads in alternation, for ``seconds`` in total."""
    options = [RasterOptions(background=BACKGROUND, threads=n) for n in threads]
    forward = make_backend("cpu").forward
    drawn = [forward(*scene.gaussians, view, options[0]) for view in scene.views]
    visible = sum(d.num_visible for d in drawn) / len(drawn)
    tile_pairs = sum(d.num_intersections for d in drawn) / len(drawn)
    del drawn
    walls: list[list[float]] = [[] for _ in threads]
    cpus: list[list[float]] = [[] for _ in threads]
    end = time.monotonic() + seconds
    while time.monotonic() < end or len(walls[0]) < MIN_TURNS:
        for option, wall, cpu in zip(options, walls, cpus, strict=True):
            start, cpu_start = time.perf_counter(), time.process_time()
            for view in scene.views:
                forward(*scene.gaussians, view, option)
            each = 1e3 / len(scene.views)
            wall.append(each * (time.perf_counter() - start))
            cpu.append(each * (time.process_time() - cpu_start) / option.threads)
    return [
        Drawing(n, len(scene.views), Spread.of(wall), Spread.of(cpu), visible, tile_pairs)
        for n, wall, cpu in zip(threads, walls, cpus, strict=True)
    ]


def report_drawings(scene: Scene, threads: Sequence[int], seconds: float) -> dict[str, Any]:
    """Print the table of one scene; returns its data."""
    found = drawings(scene, threads, seconds)
    camera = scene.camera
    print(
        f"\n{scene.name}; drawing alone, {found[0].views} views, {found[0].visible:.0f} Gaussians "
        f"and {found[0].tile_pairs:.0f} (Gaussian, tile) pairs in view\n{HEADER}"
    )
    for drawing in found:
        print(drawing)
    return {
        "scene": scene.name,
        "gaussians": scene.count,
        "size": [camera.width, camera.height],
        "drawings": [asdict(drawing) for drawing in found],
    }
