"""What the photographs did not see. Outputs: ``coverage.json`` with ``coverage/``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.schema import Split, Train
from pipeline.runtime.job import Job
from pipeline.scene.stage import StagePlan, StageSpec
from stages.workflow.inputs import (
    DRAWING_OPTIONS,
    MODEL,
    POSES,
    VIEWS,
    georeference,
    read_json,
    read_manifest,
    trained_gaussians,
    trained_views,
)

if TYPE_CHECKING:
    from pipeline.scene.scan import Scan
    from pipeline.scene.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    return StagePlan(run=True, reason="where the photographs leave gaps, and which views fill them")


def work(job: Job) -> None:
    from pipeline.coverage.measure import measure_coverage, world_of
    from pipeline.metrics.evaluate import choose_protocol

    views, train = trained_views(job), job.section(Train)
    measure_coverage(
        job.out,
        trained_gaussians(job),
        views,
        choose_protocol(views, job.section(Split), train),
        train,
        read_json(job.inputs["evaluate"] / "evaluation.json"),
        job.inputs["evaluate"] / "renders",
        world_of(views, read_manifest(job, "views"), georeference(job)),
        threads=job.threads,
    )


SPEC = StageSpec(
    name="coverage",
    work=work,
    decide=decide,
    inputs={
        "views": VIEWS,
        "model": MODEL,
        "train": ("train",),
        "evaluate": ("evaluate",),
        "poses": POSES,
    },
    options=("views", "split", *DRAWING_OPTIONS),
    packages=("torch", "numpy", "scipy", "opencv-contrib-python-headless"),
    memory_mb=3000,
)
