"""Camera poses and sparse points. Output: ``sparse/0`` (a COLMAP model)."""

from pipeline.config.schema import Sfm
from pipeline.runtime.job import Job
from pipeline.scene.manifest import Manifest
from pipeline.sfm.mapping import reconstruct
from stages.command import main


def run(job: Job) -> None:
    manifest = Manifest.read(job.inputs["photos"] / "images.json")
    report = reconstruct(
        manifest,
        job.inputs["matches"] / "database.db",
        job.section(Sfm),
        job.out,
        threads=job.threads,
        seed=job.seed,
    )
    job.record(report)


if __name__ == "__main__":
    main("sfm", run, __doc__)
