"""Develop RAW files, all views of a scene alike. Outputs: ``images/`` and ``images.json``."""

from pipeline.config.schema import Decode
from pipeline.photos.raw import develop
from pipeline.runtime.job import Job
from pipeline.scene.manifest import Manifest
from stages.command import main


def run(job: Job) -> None:
    manifest = Manifest.read(job.inputs["photos"] / "images.json")
    report = develop(manifest, job.section(Decode), job.out, threads=job.threads)
    for text in report.warnings:
        job.warn(text)
    job.counters = {"developed": len(report.manifest.photos)}


if __name__ == "__main__":
    main("decode", run, __doc__)
