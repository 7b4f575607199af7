"""``python -m benchmarks.memory``: peak memory of training, against the estimate of the plan.

Trains a synthetic scene of many views and Gaussians for a few steps with every phase: coarse and
full images, all SH bands, density control, a checkpoint. All views are the same noise image,
because memory does not depend on the content.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.results import MemoryResult
from pipeline.config.density import Gradient
from pipeline.config.settled import TrainOptions
from pipeline.demo.cameras import lens, orbit
from pipeline.plan.training_memory import memory_mb
from pipeline.runtime.machine import usable_cores
from pipeline.runtime.memory import peak_memory_mb
from pipeline.scene.views import View, scene_extent
from pipeline.splats.gaussians import Gaussians
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop import session
from pipeline.training.loop.train import train
from pipeline.training.run import TrainingRun

PIXELS_ACROSS = 3.0  # The 3-sigma radius of a Gaussian.


def made_views(count: int, width: int, height: int, folder: Path) -> list[View]:
    """``count`` views of one image, around the origin."""
    rng = np.random.default_rng(0)
    small = rng.integers(0, 256, (height // 8 + 1, width // 8 + 1, 3), np.uint8)
    picture = Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC)
    picture.save(folder / "0.jpg")
    camera = lens("none", width, height)
    fx, fy, cx, cy = camera.params
    views = []
    for number, posed in enumerate(orbit([str(i) for i in range(count)], seed=0)):
        image = folder / f"{number}.jpg"
        if number:
            os.link(folder / "0.jpg", image)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = posed.rotation, posed.translation
        views.append(View(image.name, str(image), None, width, height, fx, fy, cx, cy, pose, False))
    return views


def made_gaussians(count: int, focal: float) -> Gaussians:
    """Small Gaussians spread over the middle of the scene."""
    rng = np.random.default_rng(1)
    scale = PIXELS_ACROSS / 3 * 2.3 / focal
    return Gaussians.from_arrays({
        "means": rng.uniform(-1, 1, (count, 3)) + np.array([0, 0, 0.45]),
        "log_scales": np.log(scale) + rng.normal(0, 0.3, (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "opacity_logits": rng.normal(0, 1, count),
        "sh": rng.normal(0, 0.3, (count, 16, 3)),
    })  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--views", type=int, default=200)
    parser.add_argument("--size", type=int, nargs=2, default=[1600, 1067], metavar=("W", "H"))
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument(
        "--memory-mb", type=int, help="partition.memory_mb: images are read from disk"
    )
    parser.add_argument("--threads", type=int, default=usable_cores())
    add_record_options(parser)
    args = parser.parse_args()
    width, height = args.size
    session.CHECKPOINT_SECONDS = 0.5  # A fast machine writes one as well.
    with TemporaryDirectory() as name:
        folder = Path(name)
        views = made_views(args.views, width, height, folder)
        result = train(
            Inputs(views, made_gaussians(args.gaussians, views[0].fx), scene_extent(views)),
            TrainingRun(
                TrainOptions(steps=args.steps, density=Gradient(max_gaussians=args.gaussians)),
                folder / "checkpoints",
                threads=args.threads,
                memory_mb=args.memory_mb,
            ),
        )
        saved = sum(file.stat().st_size for file in (folder / "checkpoints").rglob("*"))
    planned = memory_mb(args.views * width * height, args.gaussians)
    figures = MemoryResult(
        gaussians=len(result.gaussians),
        most_gaussians=result.counters["max_gaussians"],
        views=args.views,
        width=width,
        height=height,
        seconds_a_step=round(result.seconds / result.steps, 3),
        checkpoints_mb=round(saved / 1e6),
        planned_mb=min(planned, args.memory_mb or planned),
        peak_mb=round(peak_memory_mb() * 2**20 / 1e6),
    )
    for key, value in asdict(figures).items():
        print(f"{key:18} {value}")
    if args.json:
        write_record(args.json, measured("memory", args.note), [figures])
    return 0


if __name__ == "__main__":
    sys.exit(main())
