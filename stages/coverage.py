"""Coverage of the scene by its photographs. Outputs: ``coverage.json`` with ``coverage/``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.schema import Split
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    return StagePlan(run=True, reason="finds gaps in the coverage and viewpoints that fill them")


def work(job: Job) -> None:
    from pipeline.coverage.measure import measure_coverage, world_frame
    from pipeline.coverage.record import CoverageRecord
    from pipeline.metrics.evaluation import Evaluation
    from pipeline.metrics.protocol import choose_protocol
    from pipeline.render.registry import use_device

    views, train = inputs.trained_views(job), inputs.drawing(job)
    use_device(train.device)
    protocol = choose_protocol(views, job.section(Split), train)
    measure_coverage(
        job.out,
        inputs.trained_gaussians(job),
        views,
        protocol,
        protocol.options(train, job.threads),
        Evaluation.read_for(job.inputs["evaluate"], [view.name for view in views]),
        job.inputs["evaluate"] / "renders",
        world_frame(views, inputs.read_manifest(job, "views"), inputs.georeference(job)),
    )
    job.decide(CoverageRecord.read(job.out).headline())


SPEC = StageSpec(
    name="coverage",
    work=work,
    decide=decide,
    inputs={**inputs.TRAINED, "evaluate": ("evaluate",)},
    options=("views", "split", *inputs.DRAWING_OPTIONS),
    packages=("torch", "numpy", "scipy", "opencv-contrib-python-headless"),
)
