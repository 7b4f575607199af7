"""SIFT keypoints and descriptors. Output: one ``.npz`` per photograph."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.schema import Features
from pipeline.plan.stage import StageSpec, unless_posed
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.sfm.counters import FeaturesCounters
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    config = settled.config.features
    longest = min(max(max(size) for size in scan.sizes), config.max_long_side_px)
    keypoints = (
        f"up to {config.max_features} SIFT keypoints per image ({config.backend}), at {longest} px"
    )
    return unless_posed(scan, "keypoints for estimating the poses", [keypoints])


def work(job: Job) -> None:
    from pipeline.sfm.features import extract_features

    report = extract_features(
        inputs.read_manifest(job, "photos"),
        job.section(Features),
        job.out,
        cache=job.shared_cache,
        threads=job.threads,
    )
    job.record(report.counters, report.decisions, report.warnings)
    # Not a counter: it depends on earlier runs.
    job.timings["num_cached"] = report.num_cached


SPEC = StageSpec(
    name="features",
    work=work,
    decide=decide,
    counters=FeaturesCounters,
    inputs={"photos": inputs.PHOTOS},
    options=("features",),
    packages=("opencv-contrib-python-headless", "pycolmap"),
)
