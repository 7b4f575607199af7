"""SIFT keypoints and descriptors. Outputs: one ``.npz`` a photograph."""

from pipeline.config.schema import Features
from pipeline.runtime.job import Job
from pipeline.scene.manifest import Manifest
from pipeline.sfm.features import extract_features
from stages.command import main


def run(job: Job) -> None:
    manifest = Manifest.read(job.inputs["photos"] / "images.json")
    report = extract_features(
        manifest, job.section(Features), job.out, cache=job.shared_cache, threads=job.threads
    )
    job.record(report)
    # How the run went, not what came of it.
    job.timings["num_cached"] = job.counters.pop("num_cached")


if __name__ == "__main__":
    main("features", run, __doc__)
