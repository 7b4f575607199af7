"""SIFT keypoints and descriptors of a large scene, a job for each chunk of the photographs. Output:
one ``.npz`` per photograph of the job."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.settled import Features
from pipeline.plan.stage import StageSpec, if_several_jobs
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.sfm.counters import FeaturesCounters
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    return if_several_jobs(scan, settled, "keypoints, by chunks of the photographs", scattered=True)


def work(job: Job) -> None:
    from pipeline.sfm.chunks import chunk
    from pipeline.sfm.features import extract_photos

    report = extract_photos(
        chunk(inputs.read_manifest(job, "photos").photos, job.number, job.of_jobs),
        job.section(Features),
        job.out,
        cache=job.cache_of("features"),
        threads=job.threads,
    )
    # The stage features gives the warnings.
    job.record(report.counters, report.decisions)
    # Not a counter: it depends on earlier runs.
    job.timings["num_cached"] = report.num_cached


SPEC = StageSpec(
    name="extract",
    work=work,
    decide=decide,
    counters=FeaturesCounters,
    inputs={"photos": inputs.PHOTOS},
    options=("features",),
    packages=("opencv-contrib-python-headless", "pycolmap"),
    scattered=True,
)
