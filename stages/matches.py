"""Match and verify pairs of photographs. Output: ``database.db`` (COLMAP's)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.experiments import Experiments
from pipeline.config.schema import Matches, Sfm
from pipeline.plan.stage import StageSpec, unless_posed
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.sfm.counters import MatchesCounters
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    return unless_posed(scan, "matches for estimating the poses", [settled.why["matches.pairs"]])


def work(job: Job) -> None:
    from pipeline.sfm.matching import match_features

    report = match_features(
        inputs.read_manifest(job, "photos"),
        job.inputs["features"],
        job.section(Matches),
        job.section(Sfm),
        job.out,
        cache=job.shared_cache,
        threads=job.threads,
        seed=job.seed,
        experiments=job.section(Experiments).matches,
    )
    job.record(report.counters, report.decisions, report.warnings)
    # Not a counter: it depends on earlier runs.
    job.timings["num_cached"] = report.num_cached


SPEC = StageSpec(
    name="matches",
    work=work,
    decide=decide,
    counters=MatchesCounters,
    inputs={"photos": inputs.PHOTOS, "features": ("features",)},
    options=("matches", "sfm.camera_model", "sfm.share_cameras", "experiments.matches"),
    packages=("pycolmap",),
    seeded=True,
)
