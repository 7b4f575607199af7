"""What the levels of detail of Streamed SOG lose, at the distance at which a viewer shows them.

    python -m benchmarks.levels [results/NAME] --json RECORD.json

The scene is the demo's, trained as by ``benchmarks.light`` with exact poses and rendered in its
test views, or a finished one, rendered in every eighth view. A level belongs to the distance at
which the mean distance of its Gaussians to their nearest neighbour is one pixel. The views show the
scene from there without a change of perspective: at the size in pixels that makes the median
distance of the Gaussians from the camera the level's. Renders are compared with those of all
Gaussians at that size, and with those at the views' full size, averaged: small Gaussians look too
thick from afar, since renderers widen them. SOG's compression is not included.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.files import Bench
from benchmarks.light import Setup, first_of, read_scene, write_world
from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.record_tables import levels
from benchmarks.results import LevelResult
from pipeline.config.schema import Split
from pipeline.demo.options import picture_size
from pipeline.io.streamed_sog import LEAF, num_levels
from pipeline.metrics.image import psnr
from pipeline.metrics.protocol import choose_protocol
from pipeline.render import RasterOptions
from pipeline.render.views import render_rgb, to_bytes
from pipeline.runtime.machine import usable_cores
from pipeline.scene.views import View
from pipeline.splats.arrays import NAMES, GaussianArrays, GaussianRows, collect
from pipeline.splats.chunks import Chunk, chunks_of, levels_of
from pipeline.splats.gaussians import Gaussians
from pipeline.training.run import TrainingRun
from pipeline.training.scene import train_scene

Images = list[NDArray[np.uint8]]


def whole_levels(gaussians: GaussianArrays) -> list[GaussianArrays]:
    """The levels of a scene, of all leaves, as ``write_streamed_sog`` makes them."""

    def leaves(chunk: Chunk) -> list[Chunk]:
        return [leaf for child in chunk.children for leaf in leaves(child)] or [chunk]

    tree = chunks_of(gaussians.means, np.arange(len(gaussians)), LEAF)
    count = num_levels(len(gaussians))
    parts = [
        list(levels_of(collect(GaussianRows(gaussians, leaf.rows, gaussians.sh_degree)), count))
        for leaf in leaves(tree)
    ]
    return [
        GaussianArrays(**{n: np.concatenate([getattr(p, n) for p in level]) for n in NAMES})
        for level in zip(*parts, strict=True)
    ]


def spacing_of(gaussians: GaussianArrays) -> float:
    """The mean distance of a Gaussian to its nearest neighbour."""
    from scipy.spatial import cKDTree

    return float(cKDTree(gaussians.means).query(gaussians.means, k=2)[0][:, 1].mean())


def depth_of(gaussians: GaussianArrays, views: Sequence[View]) -> float:
    """The median depth of the Gaussians that are inside the images."""
    depths = []
    for view in views:
        x, y, z = view.world_to_camera[:3, :3] @ gaussians.means.T + view.world_to_camera[:3, 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
        inside = (z > 0) & (u > 0) & (u < view.width) & (v > 0) & (v < view.height)
        depths.append(z[inside])
    return float(np.median(np.concatenate(depths)))


def resized(view: View, factor: float) -> View:
    """The view with ``factor`` times the pixels along each axis, at least one."""
    width, height = (max(1, round(size * factor)) for size in (view.width, view.height))
    x, y = width / view.width, height / view.height
    fx, cx, fy, cy = view.fx * x, view.cx * x, view.fy * y, view.cy * y
    return replace(view, width=width, height=height, fx=fx, cx=cx, fy=fy, cy=cy)


def renders(gaussians: GaussianArrays, views: Sequence[View], options: RasterOptions) -> Images:
    return [to_bytes(render_rgb(Gaussians.sharing(gaussians), view, options)) for view in views]


def averaged(images: Images, views: Sequence[View]) -> Images:
    """The images at the sizes of the views, by the mean over the area of each pixel."""
    sizes = [(view.width, view.height) for view in views]
    pairs = zip(images, sizes, strict=True)
    return [np.asarray(Image.fromarray(i).resize(s, Image.Resampling.BOX)) for i, s in pairs]


def agreement(images: Images, references: Images) -> float:
    """The mean PSNR, dB."""
    return float(np.mean([psnr(a, b) for a, b in zip(images, references, strict=True)]))


def train_demo(setup: Setup, seed: int) -> tuple[GaussianArrays, list[View], RasterOptions]:
    """Train the demo scene: its Gaussians, test views, and the options of rendering."""
    scene, options = read_scene(write_world(setup, "plain", seed)), setup.options()
    threads = usable_cores()
    with TemporaryDirectory() as scratch:
        run = TrainingRun(options, Path(scratch), seed=seed, threads=threads)
        trained = train_scene(scene, first_of(scene, seed), run)
    full = trained.result.gaussians.as_arrays()
    raster = choose_protocol(scene.views, Split(), options).options(options, threads)
    return full, [view for view in scene.views if view.is_test], raster


def read_finished(folder: Path) -> tuple[GaussianArrays, list[View], RasterOptions]:
    """A finished scene: its Gaussians, every eighth view, and the options of rendering."""
    bench = Bench(folder)
    return bench.gaussians, bench.views[::8], bench.options


def measure(
    full: GaussianArrays, views: Sequence[View], raster: RasterOptions
) -> list[LevelResult]:
    """Measure the levels of a scene."""
    depth, found, near = depth_of(full, views), [], renders(full, views, raster)
    for number, level in enumerate(whole_levels(full)):
        spacing = spacing_of(level)
        distance = views[0].fx * spacing
        far = [resized(view, depth / distance) for view in views]
        made = renders(level, far, raster)
        found.append(
            LevelResult(
                level=number,
                gaussians=len(level),
                views=len(views),
                depth=depth,
                spacing=spacing,
                distance=distance,
                pixels=f"{far[0].width}x{far[0].height}",
                psnr=agreement(made, renders(full, far, raster)) if number else None,
                psnr_averaged=agreement(made, averaged(near, far)),
                near_pixels=f"{views[0].width}x{views[0].height}",
                psnr_near=agreement(renders(level, views, raster), near) if number else None,
            )
        )
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.levels",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("folder", type=Path, nargs="?", metavar="results/NAME", help="a finished scene")
    add("--size", type=picture_size, default=(240, 180), metavar="WIDTHxHEIGHT")
    add("--views", type=int, default=48, help="photographs of the scene")
    add("--steps", type=int, default=1500)
    add("--gaussians", type=int, default=12_000, help="upper limit of their number")
    add("--seed", type=int, default=0)
    add("--work", type=Path, default=Path("build/light"), help="folder for the photographs")
    add_record_options(parser)
    asked = parser.parse_args(arguments)
    setup = Setup(asked.size, asked.views, asked.steps, asked.gaussians, "none", asked.work)
    scene = train_demo(setup, asked.seed) if asked.folder is None else read_finished(asked.folder)
    found = measure(*scene)
    if asked.json is not None:
        write_record(asked.json, measured("levels", asked.note, arguments), found)
    print(levels(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
