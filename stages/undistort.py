"""Pictures and masks as pinhole cameras see them.

Outputs: ``images/``, ``masks/``, ``images.json`` and ``sparse/0``.
"""

from pipeline.config.schema import Undistort, Views
from pipeline.photos.undistort import undistort
from pipeline.runtime.job import Job
from pipeline.scene.colmap import read_model
from pipeline.scene.manifest import Manifest
from stages.command import main


def run(job: Job) -> None:
    report = undistort(
        Manifest.read(job.inputs["photos"] / "images.json"),
        read_model(job.inputs["model"] / "sparse" / "0"),
        job.section(Undistort),
        job.section(Views),
        job.out,
        threads=job.threads,
    )
    for text in report.warnings:
        job.warn(text)
    job.counters = {"undistorted": len(report.manifest.photos)}


if __name__ == "__main__":
    main("undistort", run, __doc__)
