"""Given poses adjusted to their own tracks. Outputs: ``sparse/0`` (a COLMAP model in the given
world) and, where the given poses were moved, ``georeference.json``."""

import shutil

from pipeline.config.schema import Sfm
from pipeline.runtime.job import Job
from pipeline.scene.given import GEOREFERENCE
from pipeline.sfm.given import refine_given
from stages.command import main


def run(job: Job) -> None:
    given = job.inputs["model"]
    job.record(refine_given(given / "sparse" / "0", job.section(Sfm), job.out / "sparse" / "0"))
    if (given / GEOREFERENCE).is_file():
        shutil.copy(given / GEOREFERENCE, job.out)


if __name__ == "__main__":
    main("refine", run, __doc__)
