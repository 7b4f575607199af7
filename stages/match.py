"""Match and verify pairs of photographs of a large scene, a job for each chunk of the pairs.
Output: ``pairs.db``, a COLMAP database without images."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.plan.stage import StageSpec, if_several_jobs
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.sfm.counters import MatchCounters
from stages.workflow import inputs
from stages.workflow.matching import CHUNK_FILE, matching_scene

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    return if_several_jobs(scan, settled, "matches, by chunks of the pairs", scattered=True)


def work(job: Job) -> None:
    from pipeline.sfm.chunks import chunk
    from pipeline.sfm.matching import match_chunk
    from pipeline.sfm.pair_list import PairList

    chosen = PairList.read(job.inputs["pairs"])
    report = match_chunk(
        matching_scene(job),
        chosen,
        chunk(chosen.pairs, job.number, job.of_jobs),
        job.out / CHUNK_FILE,
        cache=job.cache_of("matches"),
        scratch=job.scratch / "pairs",
        threads=job.threads,
    )
    job.record(report.counters, report.decisions)
    # Not a counter: it depends on earlier runs.
    job.timings["num_cached"] = report.num_cached


SPEC = StageSpec(
    name="match",
    work=work,
    decide=decide,
    counters=MatchCounters,
    inputs={"photos": inputs.PHOTOS, "features": ("features",), "pairs": ("pairs",)},
    options=("sfm.camera_model", "sfm.share_cameras", "experiments.matches"),
    packages=("pycolmap",),
    seeded=True,
    scattered=True,
)
