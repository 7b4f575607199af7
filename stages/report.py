"""``metrics.json`` and ``report.html``, the page with all results of a scene."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config.experiments import Experiments
from pipeline.config.schema import Config, Split
from pipeline.plan.record import PlanRecord
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import Plan, StagePlan
from pipeline.runtime.job import Job
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    _criteria(settled.config)
    return StagePlan(run=True, reason="metrics.json and report.html")


def work(job: Job) -> None:
    from pipeline.coverage.record import CoverageRecord
    from pipeline.metrics.evaluation import Evaluation
    from pipeline.metrics.protocol import choose_protocol
    from pipeline.reporting.acceptance.command import Criteria, badge
    from pipeline.reporting.acceptance.measured import measured_of
    from pipeline.reporting.collect import collect_metrics
    from pipeline.reporting.data import TrainedScene
    from pipeline.reporting.headline import headline
    from pipeline.reporting.metrics import read_runs, with_times
    from pipeline.reporting.page import write_report
    from pipeline.reporting.scene import read_results

    start = time.perf_counter()
    views, train = inputs.trained_views(job), inputs.drawing(job)
    plan = PlanRecord.model_validate(job.key["plan"])
    evaluation = Evaluation.read_for(job.inputs["evaluate"], [view.name for view in views])
    results = job.inputs["inspect"].parent
    own = job.run_record(time.perf_counter() - start)
    metrics = collect_metrics(
        job.scene, plan, results, evaluation, seed=job.seed, versions=own.versions
    )
    metrics.write(job.out)
    runs = read_runs(metrics, results, without=job.stage) | {job.stage: own}
    protocol = choose_protocol(views, job.section(Split), train)
    frame = inputs.georeference(job)
    trained = TrainedScene(
        gaussians=inputs.filled_arrays(job),
        views=views,
        orientations={p.name: p.orientation for p in inputs.read_manifest(job, "views").photos},
        background=protocol.background,
        antialias=train.antialias,
        near=protocol.near,
        normalization=inputs.normalization(job),
        is_metric=frame is not None and frame.is_metric,
        up=None if frame is None else frame.up,
    )
    timed = with_times(metrics, runs)
    judgement = None
    if (criteria := job.key["acceptance"]) is not None:
        measured = measured_of(timed, CoverageRecord.read(job.inputs["coverage"]))
        judgement = badge(Criteria.model_validate(criteria), measured)
    data = read_results(
        job.inputs,
        timed,
        plan,
        trained,
        inputs.trained_model(job).points,
        shown=job.section(Experiments).report.views,
    )
    write_report(replace(data, judgement=judgement), job.out / "report.html")
    job.decide(headline(metrics))


def _criteria(config: Config) -> dict[str, Any] | None:
    """The rules that the page judges the result by, with their baseline.

    Raises:
        UserError: They cannot be read.
    """
    if config.acceptance is None:
        return None
    from pipeline.reporting.acceptance.command import read_criteria

    return read_criteria(Path(config.acceptance)).model_dump(mode="json")


def facts(plan: Plan) -> dict[str, Any]:
    return {"acceptance": _criteria(plan.config)}


SPEC = StageSpec(
    name="report",
    work=work,
    decide=decide,
    inputs=inputs.TRAINED
    | inputs.HOLES
    | {name: (name,) for name in ("inspect", "evaluate", "coverage", "export")},
    optional=tuple(inputs.HOLES),
    options=("experiments.report", "views", "split", "train.antialias", "train.background"),
    seeded=True,
    publishes={
        "metrics.json": "pipeline/reporting/captions/metrics.rst",
        "report.html": "pipeline/reporting/captions/page.rst",
    },
    shows_plan=True,
    facts=facts,
)
