"""What the stages that match photographs have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.experiments import Experiments
from pipeline.config.settled import Sfm
from pipeline.runtime.job import Job
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.sfm.matching import MatchingScene


# A COLMAP database with the results of the pairs of one of several jobs.
CHUNK_FILE = "pairs.db"


def matching_scene(job: Job) -> MatchingScene:
    """The photographs and features of the job. Imports pycolmap."""
    from pipeline.sfm.matching import MatchingScene

    return MatchingScene(
        manifest=inputs.read_manifest(job, "photos"),
        features=job.inputs["features"],
        sharing=job.section(Sfm),
        seed=job.seed,
        experiments=job.section(Experiments).matches,
    )
