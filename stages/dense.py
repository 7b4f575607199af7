"""Multi-view stereo of the training views. Outputs: ``maps/`` (depth, normals and confidence of
each view) and ``points.npz`` (the fused cloud)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.mvs.counters import DenseCounters
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    config = settled.config
    users = [f"export.formats: {name}" for name in config.export.dense_formats]
    if config.init.method == "dense":
        users.insert(0, "init.method: dense")
    if users:
        return StagePlan(run=True, reason=f"depth maps for {', '.join(users)}")
    reason = f"init.method: {config.init.method} and the export formats need no depth maps"
    return StagePlan(run=False, reason=reason)


def work(job: Job) -> None:
    from pipeline.mvs.dense import reconstruct

    report = reconstruct(
        inputs.training_views(job), inputs.input_model(job), job.out, job.scratch, job.threads
    )
    job.record(report.counters, report.decisions, report.warnings)


SPEC = StageSpec(
    name="dense",
    work=work,
    decide=decide,
    counters=DenseCounters,
    inputs={"views": inputs.VIEWS, "model": inputs.MODEL},
    options=("views", "split"),
    packages=("numpy", "scipy", "opencv-contrib-python-headless"),
)
