"""The first Gaussians, from sparse points or at random. Output: ``gaussians.npz``."""

from pipeline.config.schema import Features, Init, Matches, Split, Views
from pipeline.runtime.errors import UserError
from pipeline.runtime.job import Job
from pipeline.scene.colmap import read_model
from pipeline.scene.manifest import Manifest
from pipeline.scene.views import load_views
from pipeline.sfm.triangulation import triangulate
from pipeline.splats.arrays import write_arrays
from pipeline.splats.init import gaussians_from_points, gaussians_random
from stages.command import main

# Fewer sparse points than this say too little about the scene to start from.
MIN_POINTS = 100


def run(job: Job) -> None:
    config = job.section(Init)
    manifest = Manifest.read(job.inputs["views"] / "images.json")
    sparse = job.inputs["model"] / "sparse" / "0"
    model = read_model(sparse)
    views = load_views(manifest, model, job.section(Views), job.section(Split))
    train = [view for view in views if not view.is_test]
    if not train:
        raise UserError(
            "no photograph has a pose: there is nothing to train on",
            fix="check that the poses name the photographs, or set poses: ignore",
        )
    points = model.points
    if config.method != "random" and len(points) == 0:
        job.decide("the given poses come without points: triangulating them")
        report = triangulate(
            manifest,
            sparse,
            job.scratch / "triangulation",
            job.section(Features),
            job.section(Matches),
            threads=job.threads,
            seed=job.seed,
        )
        for text in report.decisions:
            job.decide(text)
        for text in report.warnings:
            job.warn(text)
        points = read_model(job.scratch / "triangulation" / "sparse" / "0").points
        job.counters["triangulated_points"] = len(points)
    method = config.method
    if method != "random" and len(points) < MIN_POINTS:
        job.warn(f"only {len(points)} sparse points: starting from random Gaussians instead")
        method = "random"
    if method == "random":
        first = gaussians_random(train, config, 0, job.seed)
    else:
        import numpy as np

        first = gaussians_from_points(points, np.array([v.centre for v in train]), config, 0)
    write_arrays(job.out / "gaussians.npz", first.arrays())
    job.decide(f"{len(first)} Gaussians from {'random places' if method == 'random' else 'points'}")
    job.counters |= {
        "num_gaussians": len(first),
        "points": len(points),
        "dropped": first.num_dropped,
        "thinned": first.num_thinned,
    }


if __name__ == "__main__":
    main("init", run, __doc__)
