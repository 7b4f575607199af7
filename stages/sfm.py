"""Camera poses and sparse points. Outputs: ``sparse/0`` (a COLMAP model), ``georeference.json``
(what frame it is in) and ``other_models`` where there are any."""

from pipeline.config.schema import Sfm
from pipeline.runtime.job import Job
from pipeline.scene.gcp import GCP_FILE
from pipeline.scene.manifest import Manifest
from pipeline.sfm.mapping import reconstruct
from stages.command import main


def run(job: Job) -> None:
    manifest = Manifest.read(job.inputs["photos"] / "images.json")
    control = job.inputs["inspect"] / GCP_FILE
    report = reconstruct(
        manifest,
        job.inputs["matches"] / "database.db",
        job.section(Sfm),
        job.out,
        threads=job.threads,
        seed=job.seed,
        ground_control=control if control.is_file() else None,
    )
    job.record(report)


if __name__ == "__main__":
    main("sfm", run, __doc__)
