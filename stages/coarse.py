"""The first part of the training of a scene, before it is divided into blocks. Outputs: as of
``train``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.plan.stage import StageSpec, if_blocks
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.training.loop.counters import TrainCounters
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    return if_blocks(settled, "the first half of the training: the surroundings of blocks")


def work(job: Job) -> None:
    from pipeline.io.npz import read_npz
    from pipeline.training.blocks.options import coarse_run
    from pipeline.training.scene import train_scene
    from stages.workflow.training import scene_data, training_run

    trained = train_scene(
        scene_data(job),
        read_npz(job.inputs["init"] / "gaussians.npz"),
        coarse_run(training_run(job)),
    )
    inputs.write_trained(job, trained)


SPEC = StageSpec(
    name="coarse",
    work=work,
    decide=decide,
    counters=TrainCounters,
    inputs={"views": inputs.VIEWS, "model": inputs.MODEL, "init": ("init",)},
    options=("train", "views", "split", "experiments.train"),
    packages=("torch", "numpy", "opencv-contrib-python-headless"),
    seeded=True,
)
