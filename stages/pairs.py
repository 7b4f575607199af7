"""The pairs of photographs that the jobs of ``match`` share. Output: ``pairs.json``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.settled import Matches
from pipeline.plan.stage import StageSpec, if_several_jobs
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.sfm.counters import PairsCounters
from stages.workflow import inputs
from stages.workflow.matching import matching_scene

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    return if_several_jobs(scan, settled, "pairs that several jobs match")


def work(job: Job) -> None:
    from pipeline.sfm.matching import choose_pairs

    chosen = choose_pairs(matching_scene(job), job.section(Matches))
    chosen.write(job.out)
    job.record(PairsCounters(num_pairs=len(chosen.pairs)), chosen.decisions)


SPEC = StageSpec(
    name="pairs",
    work=work,
    decide=decide,
    counters=PairsCounters,
    inputs={"photos": inputs.PHOTOS, "features": ("features",)},
    options=("matches", "sfm.camera_model", "sfm.share_cameras", "experiments.matches"),
    packages=("pycolmap",),
    seeded=True,
)
