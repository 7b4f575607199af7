"""Match and verify pairs of photographs. Output: ``database.db`` (COLMAP's)."""

from pipeline.config.schema import Matches, Sfm
from pipeline.runtime.job import Job
from pipeline.scene.manifest import Manifest
from pipeline.sfm.matching import match_features
from stages.command import main


def run(job: Job) -> None:
    manifest = Manifest.read(job.inputs["photos"] / "images.json")
    report = match_features(
        manifest,
        job.inputs["features"],
        job.section(Matches),
        job.section(Sfm),
        job.out,
        cache=job.shared_cache,
        threads=job.threads,
        seed=job.seed,
    )
    job.record(report)
    # How the run went, not what came of it.
    job.timings["num_cached"] = job.counters.pop("num_cached")


if __name__ == "__main__":
    main("matches", run, __doc__)
