"""Train a block to the end, among the Gaussians that the other blocks have become, a job for each
block. Outputs: ``gaussians.npz`` and ``curve.json``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.plan.stage import StageSpec, if_blocks
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.training.loop.counters import TrainCounters
from stages.workflow import blocks

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    return if_blocks(settled, "each block among the others as they are trained", scattered=True)


def work(job: Job) -> None:
    from pipeline.training.blocks.options import SECOND

    blocks.train(job, lambda: blocks.union_of(job, "block"), SECOND)


SPEC = StageSpec(
    name="polish",
    work=work,
    decide=decide,
    counters=TrainCounters,
    inputs=blocks.INPUTS | {"block": ("block",)},
    options=blocks.OPTIONS,
    packages=("torch", "numpy", "opencv-contrib-python-headless"),
    seeded=True,
    scattered=True,
)
