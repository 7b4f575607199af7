"""Bundle adjustment of given poses with their own tracks. Outputs: ``sparse/0`` (a COLMAP model in
the given world) and, if the given poses were translated, ``georeference.json``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.settled import Sfm
from pipeline.io.poses.formats import MIN_IMAGES_PER_CAMERA
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.sfm.counters import RefineCounters
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled

# The pose of a photograph with fewer observations is poorly determined, and would not follow the
# other poses.
MIN_TRACKED = 20


def decide(scan: Scan, settled: Settled) -> StagePlan:
    poses, freed = scan.poses, settled.config.sfm.refine_principal_point
    if poses is None:
        return StagePlan(run=False, reason="no poses are given; sfm adjusts the poses it finds")
    if (wanted := settled.config.poses) in ("keep", "trust"):
        return StagePlan(
            run=False, reason=f"given poses are not adjusted, as configured (poses: {wanted})"
        )
    if freed == "no":
        return StagePlan(run=False, reason="principal points are fixed, as configured")
    if scan.few_views:
        return StagePlan(run=False, reason="the given tracks are not used (split.train_views)")
    if poses.tracked < MIN_TRACKED:
        few = f"an image with only {poses.tracked} tracked points" if poses.tracked else "no tracks"
        return StagePlan(run=False, reason=f"the given model has {few}, too few for adjustment")
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
        decisions=["bundle adjustment with the given tracks, used if the fit improves enough"],
    )


def work(job: Job) -> None:
    from pipeline.sfm.known_poses import refine_known_poses, write_adjusted

    given = job.inputs["model"] / "sparse" / "0"
    model, report = refine_known_poses(given, job.section(Sfm))
    write_adjusted(model, given, job.out / "sparse" / "0")
    job.record(report.counters, report.decisions)
    inputs.copy_georeference(job, "model")


SPEC = StageSpec(
    name="refine",
    work=work,
    decide=decide,
    counters=RefineCounters,
    inputs={"model": inputs.GIVEN},
    options=("sfm.refine_principal_point",),
    packages=("pycolmap", "numpy", "scipy"),
)
