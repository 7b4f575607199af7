"""Matches and two-view geometries of all pairs of photographs, computed here or by the jobs of
``match``. Outputs: ``database.db`` (COLMAP's) and ``keypoint_colors.npz``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.settled import Features, Matches
from pipeline.plan.stage import StageSpec, unless_posed
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.sfm.counters import MatchesCounters
from stages.workflow import inputs
from stages.workflow.matching import CHUNK_FILE, matching_scene

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    return unless_posed(scan, "matches for estimating the poses", [settled.why["matches.pairs"]])


def work(job: Job) -> None:
    from pipeline.sfm.matching import match_features
    from pipeline.sfm.pair_list import PairList
    from pipeline.sfm.second_look import SecondLook

    scene, parts = matching_scene(job), inputs.of_jobs(job, "match")
    look = SecondLook(job.section(Features), job.cache_of("features"), job.scratch / "features")
    report = match_features(
        scene,
        job.section(Matches),
        job.out / "database.db",
        cache=job.shared_cache,
        threads=job.threads,
        chosen=PairList.read(job.inputs["pairs"]) if parts else None,
        parts=[part / CHUNK_FILE for part in parts],
        look=look,
    )
    job.record(report.counters, report.decisions, report.warnings)
    if not parts:
        # Not a counter: it depends on earlier runs.
        job.timings["num_cached"] = report.num_cached


SPEC = StageSpec(
    name="matches",
    work=work,
    decide=decide,
    counters=MatchesCounters,
    inputs={
        "photos": inputs.PHOTOS,
        "features": ("features",),
        "pairs": ("pairs",),
        "match": ("match",),
    },
    optional=("pairs", "match"),
    options=("features", "matches", "sfm.camera_model", "sfm.share_cameras", "experiments.matches"),
    packages=("pycolmap", "opencv-contrib-python-headless"),
    seeded=True,
)
