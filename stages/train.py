"""Optimise the Gaussians. Outputs: ``gaussians.npz`` and ``curve.json``."""

import sys
import time

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
    start = time.perf_counter()
    result = train(
        [view for view in views if not view.is_test],
        Gaussians.load(job.inputs["init"] / "gaussians.npz"),
        job.section(Train),
        seed=job.seed,
        threads=job.threads,
        extent=scene_extent(views),
        checkpoint_dir=job.scratch / "checkpoints",
        on_log=lambda text: print(text, file=sys.stderr, flush=True),
    )
    # After a kill: what earlier processes spent on the same training.
    earlier = max(0.0, result.seconds - (time.perf_counter() - start))
    job.warnings += result.warnings
    result.gaussians.save(job.out / "gaussians.npz")
    write_json(job.out / "curve.json", result.curve)
    job.counters = {
        "num_gaussians": len(result.gaussians),
        "steps": result.steps,
        **result.counters,
    }
    job.timings = {"curve_seconds": result.curve_seconds, "earlier_s": round(earlier, 3)}


if __name__ == "__main__":
    main("train", run, __doc__)
