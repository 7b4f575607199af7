"""Train a block among the coarse Gaussians of the others, a job for each block. Outputs:
``gaussians.npz`` and ``curve.json``."""

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
    return if_blocks(settled, "each block among coarse surroundings", scattered=True)


def work(job: Job) -> None:
    from pipeline.io.npz import read_gaussian_arrays
    from pipeline.training.blocks.options import FIRST

    coarse = job.inputs["coarse"] / "gaussians.npz"
    blocks.train(job, lambda: read_gaussian_arrays(coarse), FIRST)


SPEC = StageSpec(
    name="block",
    work=work,
    decide=decide,
    counters=TrainCounters,
    inputs=blocks.INPUTS,
    options=blocks.OPTIONS,
    packages=("torch", "numpy", "opencv-contrib-python-headless"),
    seeded=True,
    scattered=True,
)
