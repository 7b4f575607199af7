"""Optimise the Gaussians. Outputs: ``gaussians.npz`` and ``curve.json``."""

from pipeline.config.schema import Split, Train, Views
from pipeline.runtime.atomic import write_json
from pipeline.runtime.job import Job
from pipeline.scene.colmap import read_model
from pipeline.scene.manifest import Manifest
from pipeline.scene.views import load_views, scene_extent
from pipeline.splats.gaussians import Gaussians
from pipeline.training.trainer import train
from stages.command import main


def run(job: Job) -> None:
    views = load_views(
        Manifest.read(job.inputs["views"] / "images.json"),
        read_model(job.inputs["model"] / "sparse" / "0"),
        job.section(Views),
        job.section(Split),
    )
    result = train(
        [view for view in views if not view.is_test],
        Gaussians.load(job.inputs["init"] / "gaussians.npz"),
        job.section(Train),
        seed=job.seed,
        threads=job.threads,
        extent=scene_extent(views),
        checkpoint_dir=job.scratch / "checkpoints",
    )
    for text in result.warnings:
        job.warn(text)
    result.gaussians.save(job.out / "gaussians.npz")
    write_json(job.out / "curve.json", result.curve)
    job.counters = {
        "num_gaussians": len(result.gaussians),
        "steps": result.steps,
        **result.counters,
    }
    job.timings = {"curve_seconds": result.curve_seconds}


if __name__ == "__main__":
    main("train", run, __doc__)
