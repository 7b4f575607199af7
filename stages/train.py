"""Optimise the Gaussians. Outputs: ``gaussians.npz``, ``curve.json``, ``exposure.json``; and
``sparse/0`` if poses or intrinsics were refined."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.experiments import Experiments
from pipeline.config.schema import Train
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import Plan, StagePlan
from pipeline.runtime.job import Job
from pipeline.training.loop.counters import TrainCounters
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    from pipeline.plan.budget import length_line, memory_line, resolution_line

    config, why = settled.config, settled.why
    settled_options = ("train.density.max_gaussians", "train.background", "train.depth_loss_weight")
    decisions = [
        resolution_line(scan, config),
        *(why[name] for name in (*settled_options, "views.masks")),
        memory_line(scan, config),
    ]
    return StagePlan(
        run=True, reason=length_line(config), decisions=[text for text in decisions if text]
    )


def work(job: Job) -> None:
    from pipeline.io.colmap import write_model
    from pipeline.io.npz import read_npz, write_npz
    from pipeline.training.scene import train_scene

    trained = train_scene(
        inputs.input_views(job),
        inputs.read_manifest(job, "views"),
        inputs.input_model(job),
        read_npz(job.inputs["init"] / "gaussians.npz"),
        job.section(Train),
        job.section(Experiments).train,
        seed=job.seed,
        threads=job.threads,
        memory_mb=job.memory_mb,
        checkpoint_dir=job.scratch / "checkpoints",
        logs=job.logs,
    )
    write_npz(job.out / "gaussians.npz", trained.result.gaussians)
    if trained.model is not None:
        write_model(job.out / "sparse" / "0", trained.model)
    trained.result.curve.write(job.out)
    trained.gains.write(job.out)
    job.record(trained.counters, trained.decisions, trained.warnings)
    job.timings = trained.timings


def memory_mb(plan: Plan) -> int:
    """The configured limit, or 1.5 times the plan's estimate."""
    return plan.config.train.memory_mb or round(1.5 * plan.facts.training_memory_mb)


SPEC = StageSpec(
    name="train",
    work=work,
    decide=decide,
    counters=TrainCounters,
    inputs={"views": inputs.VIEWS, "model": inputs.MODEL, "init": ("init",)},
    options=("train", "views", "split", "experiments.train"),
    packages=("torch", "numpy", "opencv-contrib-python-headless"),
    seeded=True,
    memory_mb=memory_mb,
)
