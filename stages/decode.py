"""Develop RAW and EXR files with common settings for all photographs of a scene, and choose frames
of videos.

Outputs: ``images/``, ``images.json``; with given poses, ``sparse/0`` with the names of the
developed images; and ``georeference.json`` if the given poses were translated.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.schema import Decode, Inspect, Video
from pipeline.photos.counters import DecodeCounters
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import StagePlan
from pipeline.plan.video_files import contents, description
from pipeline.runtime.job import Job
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    reasons, decisions = [], []
    if scan.num_linear:
        reasons.append(f"{scan.num_linear} of {len(scan.photos)} photographs are RAW or EXR")
        decisions.append(_developing(settled.config.decode))
    if scan.videos:
        decisions += [description(video) for video in scan.videos]
        reasons.append(f"{contents(0, len(scan.videos))}: at most {len(scan.frames)} frames")
    if not reasons:
        return StagePlan(run=False, reason="no RAW or EXR files, no videos")
    return StagePlan(run=True, reason="; ".join(reasons), decisions=decisions)


def _developing(config: Decode) -> str:
    depth = "16-bit linear" if config.linear else "8-bit sRGB"
    half = ", half size" if config.half_size else ""
    return (
        f"{depth}, {config.demosaic} demosaicking{half}, one white balance "
        f"({config.white_balance}) for all"
    )


def work(job: Job) -> None:
    from pipeline.io.colmap import write_model
    from pipeline.photos.develop import develop
    from pipeline.photos.video import extract_frames
    from pipeline.plan.given_poses import renamed

    manifest = inputs.read_manifest(job, "photos")
    report = develop(manifest, job.section(Decode), job.out, threads=job.threads)
    if (job.inputs["photos"] / "sparse" / "0").is_dir():
        given = renamed(inputs.input_model(job, "photos"), report.manifest)
        write_model(job.out / "sparse" / "0", given)
    inputs.copy_georeference(job, "photos")
    counters = DecodeCounters(developed=len(report.manifest.photos))
    job.record(counters, [], report.warnings)
    if report.manifest.videos:
        least = job.section(Inspect).min_images
        found = extract_frames(
            report.manifest, job.section(Video), job.out, threads=job.threads, min_photos=least
        )
        frames = {"frames_chosen": found.chosen, "frames_decoded": found.total}
        job.record(counters.model_copy(update=frames), found.decisions, found.warnings)


SPEC = StageSpec(
    name="decode",
    work=work,
    decide=decide,
    counters=DecodeCounters,
    inputs={"photos": ("inspect",)},
    options=("decode", "video", "inspect.min_images"),
    packages=("rawpy", "opencv-contrib-python-headless"),
)
