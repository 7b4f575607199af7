"""Undistort photographs, masks and depth maps to pinhole cameras.

Outputs: ``images/``, ``masks/``, ``depths/``, ``images.json`` and ``sparse/0``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.schema import Undistort, Views
from pipeline.photos.counters import UndistortCounters
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


WIDE_MODELS = {"EQUIRECTANGULAR", "OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}


def decide(scan: Scan, settled: Settled) -> StagePlan:
    if scan.poses is not None:
        models = ", ".join(scan.poses.models)
        decisions = [_splitting()] if set(scan.poses.models) & WIDE_MODELS else []
        if scan.poses.pinhole:
            return StagePlan(run=False, reason=f"the given cameras are pinhole cameras ({models})")
        if models == "EQUIRECTANGULAR":
            return StagePlan(
                run=True, reason="the given cameras are panoramas", decisions=decisions
            )
        reason = f"the given cameras have lens distortion ({models})"
        return StagePlan(run=True, reason=reason, decisions=decisions)
    model = settled.config.sfm.camera_model
    if scan.num_panoramas or model == "EQUIRECTANGULAR":
        count = len(scan.planned) if model == "EQUIRECTANGULAR" else scan.num_panoramas
        reason = f"{count} photographs are panoramas"
        return StagePlan(run=True, reason=reason, decisions=[_splitting()])
    if model == "OPENCV_FISHEYE":
        reason = f"{model} cameras have lens distortion"
        return StagePlan(run=True, reason=reason, decisions=[_splitting()])
    if model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return StagePlan(run=False, reason=f"{model} cameras have no lens distortion")
    return StagePlan(run=True, reason=f"{model} cameras have lens distortion")


def _splitting() -> str:
    return (
        "panoramas, and photographs of fisheye lenses of more than 110 degrees along a side, are "
        "split into overlapping pinhole views"
    )


def work(job: Job) -> None:
    from pipeline.photos.undistort import undistort

    report = undistort(
        inputs.read_manifest(job, "photos"),
        inputs.input_model(job),
        job.section(Undistort),
        job.section(Views),
        job.out,
        threads=job.threads,
    )
    counters = UndistortCounters(undistorted=report.photographs)
    if report.split:
        wide = {"split": report.split, "views": len(report.manifest.photos)}
        counters = counters.model_copy(update={**wide, "used_share": report.used_share})
    job.record(counters, report.decisions, report.warnings)


SPEC = StageSpec(
    name="undistort",
    work=work,
    decide=decide,
    counters=UndistortCounters,
    inputs={"photos": inputs.PHOTOS, "model": inputs.POSES},
    options=("undistort", "views.max_long_side_px"),
    packages=("opencv-contrib-python-headless",),
)
