"""Scenes in blocks beside the same scenes as one block: quality, memory, time and seams.

    python -m benchmarks.blocks results town town@four south_building south_building@four

Runs are finished folders of results, in pairs: as one block, and in blocks.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.results import BlocksResult
from pipeline.io.npz import read_npz
from pipeline.metrics.evaluation import Evaluation
from pipeline.photos.load import load_view
from pipeline.plan.posed_scene import posed_scene
from pipeline.plan.record import read_plan
from pipeline.render import RasterOptions, make_backend
from pipeline.render.views import near_plane, raster_camera
from pipeline.reporting.metrics import read_metrics, read_runs
from pipeline.runtime.record import read_run
from pipeline.scene.blocks import Partition
from pipeline.scene.views import View, scene_extent
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.init import SH_C0

# Neighbouring pixels are on one surface if their depths differ by less than this share.
SAME_SURFACE = 0.02
# Stages that exist because of blocks, or whose work they take over.
TRAINING = ("coarse", "partition", "block", "polish", "train")


def compare(results: Path, whole: str, divided: str) -> BlocksResult:
    """Compare a finished run in blocks with one of the same scene as one block."""
    folders = results / whole, results / divided
    one, many = map(read_metrics, folders)
    plan = read_plan(results / divided)
    return BlocksResult(
        run=whole,
        seed=many.seed,
        pixels=one.protocol.resolution[0],
        photographs=one.registered_images or 0,
        test_views=one.protocol.num_views,
        blocks=plan.stages["polish"].jobs,
        psnr=(one.psnr, many.psnr),
        ssim=(one.ssim, many.ssim),
        gaussians=(one.num_gaussians, many.num_gaussians),
        training_rss_mb=(_peak(folders[0], TRAINING), _peak(folders[1], TRAINING)),
        peak_rss_mb=(_peak(folders[0]), _peak(folders[1])),
        training_cpu_s=(_cpu(folders[0]), _cpu(folders[1])),
        largest_block_cpu_s=_largest_block(folders[1]),
        seam_gradient=_seams(*folders),
    )


def _peak(folder: Path, stages: Collection[str] | None = None) -> float:
    """The largest memory of a job of these stages, or of any job, MiB."""
    runs = read_runs(read_metrics(folder), folder)
    return max(run.peak_rss_mb for stage, run in runs.items() if stages is None or stage in stages)


def _cpu(folder: Path) -> float:
    runs = read_runs(read_metrics(folder), folder)
    return sum(run.cpu_s for stage, run in runs.items() if stage in TRAINING)


def _largest_block(folder: Path) -> float:
    """The CPU seconds of the block that takes longest, both rounds together."""
    jobs = read_plan(folder).stages["polish"].jobs
    return max(
        sum(read_run(folder / f"{stage}_{number}").cpu_s for stage in ("block", "polish"))
        for number in range(1, jobs + 1)
    )


@dataclass
class _Sum:
    total: float = 0.0
    count: int = 0

    def add(self, values: NDArray[np.float64]) -> None:
        self.total += float(values.sum())
        self.count += values.size

    @property
    def mean(self) -> float:
        return self.total / self.count if self.count else float("nan")


class _Renders:
    """The renders of a run's test views, and the gradients of their errors."""

    def __init__(self, folder: Path):
        self.folder = folder / "evaluate"
        self.files = {view.name: view.render for view in Evaluation.read(self.folder).per_view}
        self.at_seams, self.elsewhere = _Sum(), _Sum()

    def error(self, view: View) -> NDArray[np.float64]:
        """The mean absolute difference of the channels from the photograph, (H, W)."""
        with Image.open(self.folder / "renders" / self.files[view.name]) as picture:
            return np.abs(np.asarray(picture, np.float64) - load_view(view).rgb).mean(2)


def _seams(whole: Path, divided: Path) -> tuple[float, float]:
    """The mean gradient of the error images of the test views across the seams of the second run,
    divided by that elsewhere, in both runs.

    Both are over pairs of neighbouring pixels on one surface. A seam is between pixels that
    different blocks explain most of.
    """
    scene = posed_scene(divided, None, None)
    partition = Partition.read(divided / "partition")
    gaussians = read_npz(divided / "train" / "gaussians.npz")
    options = RasterOptions(sh_degree=0, near=near_plane(scene_extent(list(scene.views))))
    runs = [_Renders(folder) for folder in (whole, divided)]
    for view in scene.views:
        if view.name not in runs[1].files:
            continue
        errors = [run.error(view) for run in runs]
        owner, depth = _owners(gaussians, partition, view, options)
        for axis in (0, 1):
            first = np.take(depth, range(depth.shape[axis] - 1), axis)
            step = np.abs(np.diff(depth, axis=axis))
            surface = (first > 0) & (step < SAME_SURFACE * first)
            crossing = np.diff(owner, axis=axis) != 0
            for run, error in zip(runs, errors, strict=True):
                change = np.abs(np.diff(error, axis=axis))
                run.at_seams.add(change[surface & crossing])
                run.elsewhere.add(change[surface & ~crossing])
    one, many = (run.at_seams.mean / run.elsewhere.mean for run in runs)
    return one, many


def _owners(
    gaussians: Gaussians, partition: Partition, view: View, options: RasterOptions
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The block that explains most of each pixel, and the median depths, both (H, W)."""
    means, count = gaussians.means.numpy(), len(partition.blocks)
    shares, white = [], 0.5 / SH_C0
    depth = None
    for start in range(1, count + 1, 3):
        numbers = range(start, min(start + 3, count + 1))
        sh = torch.full((len(gaussians), 1, 3), -white)
        for channel, number in enumerate(numbers):
            inside = torch.from_numpy(partition.box(number).contains(means))
            sh[inside, 0, channel] = white
        painted = replace(gaussians.with_sh_degree(0), sh=sh)
        rendered = make_backend().forward(*painted.parameters(), raster_camera(view), options)
        shares += [rendered.color[..., channel].numpy() for channel in range(len(numbers))]
        depth = rendered.median_depth.numpy()
    assert depth is not None
    return np.argmax(np.stack(shares), 0), depth


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.blocks", description=__doc__)
    parser.add_argument("results", type=Path, help="folder of results")
    parser.add_argument("runs", nargs="+", metavar="RUN", help="pairs: as one block, in blocks")
    add_record_options(parser)
    options = parser.parse_args(arguments)
    if len(options.runs) % 2:
        parser.error("runs are pairs: as one block, and in blocks")
    pairs = zip(options.runs[::2], options.runs[1::2], strict=True)
    results = [compare(options.results, whole, divided) for whole, divided in pairs]
    print(json.dumps([asdict(result) for result in results], indent=2))
    if options.json is not None:
        write_record(options.json, measured("blocks", options.note, arguments), results)


if __name__ == "__main__":
    main()
