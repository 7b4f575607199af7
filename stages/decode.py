"""Develop RAW files, all views of a scene alike. Outputs: ``images/``, ``images.json``, and
the given poses, if there are any, under the developed pictures' names, with ``georeference.json``
where they were moved."""

import shutil

from pipeline.config.schema import Decode
from pipeline.photos.raw import develop
from pipeline.runtime.job import Job
from pipeline.scene.colmap import read_model, write_model
from pipeline.scene.given import GEOREFERENCE, renamed
from pipeline.scene.manifest import Manifest
from stages.command import main


def run(job: Job) -> None:
    manifest = Manifest.read(job.inputs["photos"] / "images.json")
    report = develop(manifest, job.section(Decode), job.out, threads=job.threads)
    for text in report.warnings:
        job.warn(text)
    sparse = job.inputs["photos"] / "sparse" / "0"
    if sparse.is_dir():
        write_model(job.out / "sparse" / "0", renamed(read_model(sparse), report.manifest))
    if (job.inputs["photos"] / GEOREFERENCE).is_file():
        shutil.copy(job.inputs["photos"] / GEOREFERENCE, job.out)
    job.counters = {"developed": len(report.manifest.photos)}


if __name__ == "__main__":
    main("decode", run, __doc__)
