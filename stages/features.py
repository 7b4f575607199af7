"""SIFT keypoints and descriptors of all photographs, extracted here or by the jobs of ``extract``.
Output: one ``.npz`` per photograph."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.settled import Features
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
    from pipeline.runtime.counters import read_counters
    from pipeline.sfm.features import extract_features, gather_features

    manifest, config = inputs.read_manifest(job, "photos"), job.section(Features)
    cache = job.shared_cache
    if folders := inputs.of_jobs(job, "extract"):
        parts = {folder: read_counters(folder, FeaturesCounters) for folder in folders}
        report = gather_features(manifest, config, parts, job.out, cache=cache)
    else:
        report = extract_features(manifest, config, job.out, cache=cache, threads=job.threads)
        # Not a counter: it depends on earlier runs.
        job.timings["num_cached"] = report.num_cached
    job.record(report.counters, report.decisions, report.warnings)


SPEC = StageSpec(
    name="features",
    work=work,
    decide=decide,
    counters=FeaturesCounters,
    inputs={"photos": inputs.PHOTOS, "extract": ("extract",)},
    optional=("extract",),
    options=("features",),
    packages=("opencv-contrib-python-headless", "pycolmap"),
)
