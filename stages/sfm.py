"""Camera poses and sparse points. Outputs: ``sparse/0`` (a COLMAP model), ``georeference.json``
(its frame), ``uncertainty.json`` and ``other_models`` if there are any."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.settled import Config, Sfm
from pipeline.plan.stage import StageSpec, unless_posed
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.sfm.counters import SfmCounters
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    config, reasons = settled.config, settled.why
    reason = "no poses are given"
    if config.poses == "ignore":
        reason = "given poses are ignored, as configured (poses: ignore)"
    choices = [reasons[f"sfm.{name}"] for name in ("mapper", "camera_model", "share_cameras")]
    return unless_posed(scan, reason, [*choices, _frame(scan, config)])


def _frame(scan: Scan, config: Config) -> str:
    wanted = config.sfm.georeference
    if wanted == "gcp" and scan.ground_control is not None:
        return f"georeferenced by the ground control points in {scan.ground_control_text}"
    if wanted == "gps" and scan.num_gps:
        flat = sum(photo.gps is not None and photo.gps[2] is None for photo in scan.photos)
        unknown = f" ({flat} without an altitude)" if flat else ""
        return (
            f"georeferenced by GPS positions of {scan.num_gps} photographs{unknown}, if these "
            "suffice"
        )
    why = "no GPS or ground control points"
    if scan.num_gps or scan.ground_control is not None:
        why = "as configured"
    return f"not georeferenced ({why}): the scene is levelled and scaled to unit size"


def work(job: Job) -> None:
    from pipeline.io.gcp import GCP_FILE
    from pipeline.sfm.mapping import reconstruct

    control = job.inputs["inspect"] / GCP_FILE
    found = reconstruct(
        inputs.read_manifest(job, "photos"),
        job.inputs["matches"] / "database.db",
        job.section(Sfm),
        seed=job.seed,
        ground_control=control if control.is_file() else None,
    )
    found.write(job.out)
    job.record(found.report.counters, found.report.decisions, found.report.warnings)


SPEC = StageSpec(
    name="sfm",
    work=work,
    decide=decide,
    counters=SfmCounters,
    inputs={"photos": inputs.PHOTOS, "matches": ("matches",), "inspect": ("inspect",)},
    options=("sfm",),
    packages=("pycolmap", "numpy", "scipy", "pyproj"),
    seeded=True,
)
