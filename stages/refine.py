"""Given poses adjusted to their own tracks. Outputs: ``sparse/0`` (a COLMAP model in the given
world) and, where the given poses were moved, ``georeference.json``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.schema import Sfm
from pipeline.io.posefiles import MIN_IMAGES_PER_CAMERA
from pipeline.plan.stage import StagePlan, StageSpec
from pipeline.runtime.job import Job
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled

# A photograph with fewer known points is left behind when the others are adjusted to theirs.
MIN_TRACKED = 20


def decide(scan: Scan, settled: Settled) -> StagePlan:
    poses, freed = scan.poses, settled.config.sfm.refine_principal_point
    if poses is None:
        return StagePlan(run=False, reason="no poses are given; sfm adjusts its own")
    if settled.config.poses == "keep":
        return StagePlan(run=False, reason="the given poses are kept, as configured (poses: keep)")
    if freed == "no":
        return StagePlan(run=False, reason="principal points are held, as configured")
    if poses.tracked < MIN_TRACKED:
        few = f"a photograph with {poses.tracked} tracked points" if poses.tracked else "no tracks"
        return StagePlan(run=False, reason=f"the given poses come with {few} to adjust them to")
    if not poses.centred and freed != "yes":
        text = (
            f"no camera with {MIN_IMAGES_PER_CAMERA} photographs or more has its principal point "
            "exactly at the image centre"
        )
        return StagePlan(run=False, reason=text)
    return StagePlan(
        run=True,
        reason="given principal points are at the image centre, so they were not calibrated"
        if poses.centred
        else "principal points are adjusted, as configured",
        decisions=["poses, points and lenses adjusted to the given tracks, where that pays"],
    )


def work(job: Job) -> None:
    from pipeline.sfm.refine_given import refine_given

    given = job.inputs["model"]
    job.record(refine_given(given / "sparse" / "0", job.section(Sfm), job.out / "sparse" / "0"))
    inputs.copy_georeference(job, "model")


SPEC = StageSpec(
    name="refine",
    work=work,
    decide=decide,
    inputs={"model": inputs.GIVEN},
    options=("sfm.refine_radial", "sfm.refine_principal_point"),
    packages=("pycolmap", "numpy", "scipy"),
    memory_mb=4000,
)
