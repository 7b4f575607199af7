"""What the stages that train blocks have in common."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from typing import TYPE_CHECKING

from pipeline.runtime.job import Job
from pipeline.scene.blocks import Partition
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.splats.arrays import GaussianSource
    from pipeline.training.blocks.train import SceneInBlocks
    from pipeline.training.blocks.union import Union
    from pipeline.training.run import Part

INPUTS = {
    "views": inputs.VIEWS,
    "model": inputs.MODEL,
    "coarse": ("coarse",),
    "partition": ("partition",),
}
OPTIONS = ("train", "views", "split", "experiments.train")


def read_partition(job: Job) -> Partition:
    return Partition.read(job.inputs["partition"])


def union_of(job: Job, role: str) -> Union:
    """The Gaussians of all blocks, each without those outside of its box."""
    from pipeline.training.blocks.union import Union

    partition = read_partition(job)
    numbers = range(1, len(partition.blocks) + 1)
    return Union([job.inputs[f"{role}_{i}"] / "gaussians.npz" for i in numbers], partition)


def train(job: Job, open_scene: Callable[[], GaussianSource], part: Part) -> None:
    """Train the job's block and write the result.

    Args:
        open_scene: A function that returns the Gaussians of the whole scene.
    """
    from pipeline.training.blocks.train import block_training, with_far_field
    from pipeline.training.scene import run_training
    from stages.workflow.training import training_run

    trained = run_training(
        # Without a local variable, what it is made from is freed before training.
        *block_training(_scene(job, open_scene), job.number, training_run(job, part))
    )
    gaussians = with_far_field(
        trained.result.gaussians, open_scene(), read_partition(job), job.number
    )
    inputs.write_trained(job, trained, gaussians)


def _scene(job: Job, open_scene: Callable[[], GaussianSource]) -> SceneInBlocks:
    from pipeline.scene.exposure import ExposureGains
    from pipeline.splats.arrays import collect
    from pipeline.splats.gaussians import Gaussians
    from pipeline.training.blocks.train import SceneInBlocks
    from pipeline.training.scene import SceneData

    views = inputs.trained_views(job, "coarse")
    return SceneInBlocks(
        SceneData(views, inputs.read_manifest(job, "views"), inputs.trained_model(job, "coarse")),
        gains=ExposureGains.read_for(job.inputs["coarse"], [view.name for view in views]),
        partition=read_partition(job),
        read_gaussians=lambda: Gaussians.sharing(collect(open_scene())),
    )


def unite(job: Job) -> None:
    """Write the union of the trained blocks, with the coarse run's cameras and exposures."""
    from pipeline.io.colmap import has_model
    from pipeline.io.npz import write_npz
    from pipeline.runtime.counters import read_counters
    from pipeline.runtime.record import read_run
    from pipeline.scene.exposure import ExposureGains
    from pipeline.training.blocks.report import joined_counters, joined_curve, joined_seconds
    from pipeline.training.loop.counters import TrainCounters
    from pipeline.training.loop.curve import TrainingCurve

    gaussians = union_of(job, "polish")
    write_npz(job.out / "gaussians.npz", gaussians)
    coarse = job.inputs["coarse"]
    if has_model(coarse / "sparse" / "0"):
        shutil.copytree(coarse / "sparse", job.out / "sparse")
    shutil.copy(coarse / ExposureGains.file_name, job.out)
    inputs.copy_background(job)
    numbers = range(1, len(read_partition(job).blocks) + 1)
    folders = [job.inputs[f"polish_{number}"] for number in numbers]
    curve = joined_curve([TrainingCurve.read(folder) for folder in folders])
    curve.write(job.out)
    counters = [read_counters(folder, TrainCounters) for folder in folders]
    job.record(
        joined_counters(counters, len(gaussians)),
        [f"{len(gaussians)} Gaussians of {len(folders)} blocks"],
    )
    seconds = [read_run(folder).curve_seconds or [] for folder in folders]
    job.timings = {"curve_seconds": joined_seconds(seconds, len(curve.root))}
