"""Divide the scene into blocks and choose the views of each. Output: ``partition.json``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.settled import Partition, Train
from pipeline.plan.stage import StageSpec, if_blocks
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.training.blocks.counters import PartitionCounters
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    return if_blocks(settled, settled.why["partition.blocks"])


def work(job: Job) -> None:
    from pipeline.io.npz import read_npz
    from pipeline.training.blocks.partition import partition_scene
    from pipeline.training.blocks.report import describe_partition

    partition = partition_scene(
        read_npz(job.inputs["coarse"] / "gaussians.npz"),
        inputs.trained_views(job, "coarse"),
        inputs.read_manifest(job, "views"),
        int(job.section(Partition).blocks),
        job.section(Train),
        threads=job.threads,
    )
    partition.write(job.out)
    counters, decisions = describe_partition(partition)
    job.record(counters, decisions)


SPEC = StageSpec(
    name="partition",
    work=work,
    decide=decide,
    counters=PartitionCounters,
    inputs={"views": inputs.VIEWS, "model": inputs.MODEL, "coarse": ("coarse",)},
    options=("partition", "train", "views", "split"),
    packages=("torch", "numpy"),
)
