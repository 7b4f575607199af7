"""What the stages that train blocks have in common."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

from pipeline.config.experiments import Experiments
from pipeline.config.schema import Train
from pipeline.runtime.job import Job
from pipeline.scene.blocks import Partition
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.splats.gaussians import Gaussians
    from pipeline.training.loop.schedule import Part

INPUTS = {
    "views": inputs.VIEWS,
    "model": inputs.MODEL,
    "coarse": ("coarse",),
    "partition": ("partition",),
}
OPTIONS = ("train", "views", "split", "experiments.train")


def read_partition(job: Job) -> Partition:
    return Partition.read(job.inputs["partition"])


def union_of(job: Job, role: str) -> Gaussians:
    """The Gaussians of all blocks, each without those outside of its box."""
    from pipeline.io.npz import read_npz
    from pipeline.training.blocks.union import inside, union

    partition = read_partition(job)
    numbers = range(1, len(partition.blocks) + 1)
    return union(
        inside(read_npz(job.inputs[f"{role}_{number}"] / "gaussians.npz"), partition, number)
        for number in numbers
    )


def train(job: Job, scene: Gaussians, part: Part) -> None:
    """Train the job's block and write the result.

    Args:
        scene: the Gaussians of the whole scene.
    """
    from pipeline.scene.exposure import ExposureGains
    from pipeline.training.blocks.train import train_block

    views = inputs.coarse_views(job)
    trained = train_block(
        views,
        inputs.read_manifest(job, "views"),
        inputs.coarse_model(job),
        scene,
        ExposureGains.read_for(job.inputs["coarse"], [view.name for view in views]),
        read_partition(job),
        job.number,
        job.section(Train),
        job.section(Experiments).train,
        part,
        seed=job.seed,
        threads=job.threads,
        memory_mb=job.memory_mb,
        checkpoint_dir=job.scratch / "checkpoints",
        logs=job.logs,
    )
    inputs.write_trained(job, trained)


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
