"""Optimise the Gaussians. Outputs: ``gaussians.npz``, ``curve.json`` and ``exposure.json``; and
where cameras or lenses were moved with them ``sparse/0``."""

import sys
import time

import numpy as np

from pipeline.config.schema import Split, Train, Views
from pipeline.photos.exposure import measure_exposures, sample_views
from pipeline.runtime.atomic import write_json
from pipeline.runtime.job import Job
from pipeline.scene.colmap import read_model, write_model
from pipeline.scene.manifest import Manifest
from pipeline.scene.model import Reconstruction, View, with_poses
from pipeline.scene.views import load_views, scene_extent
from pipeline.splats.gaussians import Gaussians
from pipeline.training import journal
from pipeline.training.depth import KnownDepths, point_depths, scene_scale
from pipeline.training.depth_maps import add_maps
from pipeline.training.floaters import air_depths
from pipeline.training.inputs import Inputs
from pipeline.training.lenses import changed_by, with_lenses
from pipeline.training.poses import followed, moved_by
from pipeline.training.trainer import train
from stages.command import main

# Standard deviation in stops from which photographs are taken for differently exposed: cameras that
# hold their exposure show 0 to 0.1, collections from the internet 0.5. bonsai's, under a sun that
# comes and goes, show 0.18 and are left alone: its metrics stay comparable to the literature's.
EXPOSURES_DIFFER = 0.2
# Looks at each photograph, on average, below which no scene has come out sharp.
FEW_LOOKS = 3.0
FITS = {
    "factor": "depths in a unit of their own",
    "depth": "depths up to factor and shift",
    "inverse": "inverse depths up to factor and shift",
}


def run(job: Job) -> None:
    manifest = Manifest.read(job.inputs["views"] / "images.json")
    model = read_model(job.inputs["model"] / "sparse" / "0")
    views = load_views(manifest, model, job.section(Views), job.section(Split))
    has_alpha = any(photo.alpha for photo in manifest.photos)
    gains = {} if has_alpha else choose_gains(job, views, model)
    training = [view for view in views if not view.is_test]
    points = point_depths(training, model)
    wanted = job.section(Train).depth_weight
    known = find_depths(job, training, manifest, points) if wanted else None
    extent = scene_extent(views)
    start = time.perf_counter()
    result = train(
        Inputs(
            views=training,
            initial=Gaussians.load(job.inputs["init"] / "gaussians.npz"),
            extent=extent,
            scale=scene_scale(extent, points),
            gains=np.array([gains[view.name] for view in training]) if gains else None,
            depths=known,
            air=air_depths(points),
        ),
        job.section(Train),
        seed=job.seed,
        threads=job.threads,
        checkpoint_dir=job.scratch / "checkpoints",
        journal=job.logs / journal.NAME,
        on_log=lambda text: print(text, file=sys.stderr, flush=True),
    )
    # After a kill: what earlier processes spent on the same training.
    earlier = max(0.0, result.seconds - (time.perf_counter() - start))
    job.warnings += result.warnings
    minutes = job.section(Train).budget_minutes
    if few := too_few_looks(result.steps, len(training), result.seconds, minutes):
        job.warn(few)
    if minutes is not None:
        job.decide(
            f"{result.steps} steps fitted into {minutes:g} minutes; how many do depends on the "
            "machine and its load, so another run gives other bits"
        )
    if unseen := result.counters["unseen"]:
        job.decide(f"{unseen} Gaussians that no training photograph sees are left out")
    if hung := result.counters["floaters"]:
        job.decide(f"{hung} Gaussians that hung in the air before one camera were taken away")
    result.gaussians.save(job.out / "gaussians.npz")
    if result.lenses is not None:
        model = with_lenses(model, result.lenses)
        job.decide(changed_by(result.lenses))
    if result.poses is not None:
        model = with_poses(model, followed(views, result.poses))
        job.decide(moved_by(views, result.poses))
    if result.lenses is not None or result.poses is not None:
        write_model(job.out / "sparse" / "0", model)
    write_json(job.out / "curve.json", result.curve)
    write_json(job.out / "exposure.json", gains)
    job.counters |= {
        "num_gaussians": len(result.gaussians),
        "steps": result.steps,
        "known_depths": sum(map(len, known or ())),
        **result.counters,
    }
    job.timings = {
        "ms_per_step": round(1e3 * result.seconds / result.steps, 3),
        "curve_seconds": result.curve_seconds,
        "earlier_s": round(earlier, 3),
    }


def find_depths(
    job: Job, views: list[View], manifest: Manifest, points: list[KnownDepths]
) -> list[KnownDepths]:
    """Depths of the sparse points and of the user's depth maps, by view."""
    maps = {photo.name: photo.depth for photo in manifest.photos}
    known, kinds, refused = add_maps(views, points, [maps[view.name] for view in views])
    if kinds:
        fits = ", ".join(f"{count} as {FITS[kind]}" for kind, count in kinds.items())
        job.decide(f"depth maps fitted to the sparse points: {fits}")
    if refused:
        job.warn(
            f"depth maps of {len(refused)} views do not fit the sparse points, or see too few of "
            f"them, and are left out: {', '.join(refused[:5])}"
        )
    job.counters["depth_maps"] = sum(kinds.values())
    return known


def too_few_looks(steps: int, views: int, seconds: float, minutes: float | None) -> str | None:
    """What to say of a training that was too short to look at its photographs; None: it was not."""
    if steps >= FEW_LOOKS * views:
        return None
    looks = f"{steps} steps are {steps / views:.1f} looks at each of {views} photographs"
    if minutes is None:
        return f"{looks}, too few for a sharp scene: raise train.steps"
    return (
        f"{looks}, too few for a sharp scene: all that this machine did in {minutes:g} minutes, "
        f"{seconds / steps:.2g} s a step; raise train.budget_minutes or lower "
        "views.max_long_side_px, and see that nothing else keeps the machine busy"
    )


def choose_gains(job: Job, views: list[View], model: Reconstruction) -> dict[str, list[float]]:
    """Each view's gains by name; empty where the photographs are exposed alike."""
    wanted = job.section(Train).exposure
    if wanted == "off":
        return {}
    if wanted == "auto":
        spread = measure_exposures(sample_views(views), model).spread
        job.counters["exposure_spread_stops"] = round(spread, 4)
        if spread < EXPOSURES_DIFFER:
            return {}
    found = measure_exposures(views, model)
    job.decide(
        f"exposures differ by {found.spread:.2f} stops: renders are compared through gains that "
        f"were measured in {found.measured} of {len(views)} photographs"
    )
    return {v.name: gain.tolist() for v, gain in zip(views, found.gains, strict=True)}


if __name__ == "__main__":
    main("train", run, __doc__)
