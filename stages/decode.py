"""Develop RAW files, with the same settings for all photographs of a scene.

Outputs: ``images/``, ``images.json``; with given poses, ``sparse/0`` with the names of the
developed images; and ``georeference.json`` if the given poses were translated.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.schema import Decode
from pipeline.photos.counters import DecodeCounters
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    if scan.num_raw == 0:
        return StagePlan(run=False, reason="no RAW files")
    config = settled.config.decode
    depth = "16-bit linear" if config.linear else "8-bit sRGB"
    half = ", half size" if config.half_size else ""
    text = (
        f"{depth}, {config.demosaic} demosaicking{half}, one white balance "
        f"({config.white_balance}) for all"
    )
    reason = f"{scan.num_raw} of {len(scan.photos)} photographs are RAW"
    return StagePlan(run=True, reason=reason, decisions=[text])


def work(job: Job) -> None:
    from pipeline.io.colmap import write_model
    from pipeline.photos.raw import develop
    from pipeline.plan.given_poses import renamed

    manifest = inputs.read_manifest(job, "photos")
    report = develop(manifest, job.section(Decode), job.out, threads=job.threads)
    if (job.inputs["photos"] / "sparse" / "0").is_dir():
        given = renamed(inputs.input_model(job, "photos"), report.manifest)
        write_model(job.out / "sparse" / "0", given)
    inputs.copy_georeference(job, "photos")
    job.record(DecodeCounters(developed=len(report.manifest.photos)), [], report.warnings)


SPEC = StageSpec(
    name="decode",
    work=work,
    decide=decide,
    counters=DecodeCounters,
    inputs={"photos": ("inspect",)},
    options=("decode",),
    packages=("rawpy",),
)
