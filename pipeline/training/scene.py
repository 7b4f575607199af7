"""Training of a scene: prepares the inputs, runs the optimisation and describes the result."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.experiments import TrainExperiments
from pipeline.config.schema import Train
from pipeline.scene.exposure import NO_GAINS, ExposureGains
from pipeline.scene.manifest import Manifest
from pipeline.scene.reconstruction import Reconstruction, with_poses
from pipeline.scene.views import View, scene_extent
from pipeline.scene.visibility import seen_share
from pipeline.splats.gaussians import Gaussians
from pipeline.training.appearance.choose import choose_appearance
from pipeline.training.appearance.start import initial_embeddings
from pipeline.training.cameras.intrinsics import describe_intrinsics, with_intrinsics
from pipeline.training.cameras.poses import describe_poses, with_common_motion
from pipeline.training.data.dense_depths import add_dense_depths
from pipeline.training.data.depth_maps import add_maps
from pipeline.training.data.inputs import Inputs
from pipeline.training.data.known_depths import (
    KnownDepths,
    gaussian_depths,
    point_depths,
    scene_scale,
)
from pipeline.training.density.floaters import empty_depths
from pipeline.training.loop import metrics_log
from pipeline.training.loop.counters import TrainCounters
from pipeline.training.loop.result import TrainResult
from pipeline.training.loop.schedule import WHOLE_RUN, Part
from pipeline.training.loop.train import train

# Epochs (passes over the training views) below which no scene is sharp.
MIN_EPOCHS = 3.0
FITS = {
    "factor": "depths in a unit of their own",
    "depth": "depths up to factor and shift",
    "inverse": "inverse depths up to factor and shift",
}


@dataclass
class TrainedScene:
    """A finished training.

    Attributes:
        model: the reconstruction with refined cameras, None where none was refined.
        gains: of all views; empty if the photographs are exposed alike.
        decisions, warnings, counters: recorded in ``stage.json``.
        timings: recorded in ``run.json``.
    """

    result: TrainResult
    model: Reconstruction | None
    gains: ExposureGains
    decisions: list[str]
    warnings: list[str]
    counters: TrainCounters
    timings: dict[str, Any]


@dataclass(frozen=True)
class TrainingRun:
    """How a training runs. Only the seed changes the result.

    Attributes:
        threads: of the native operators.
        memory_mb: memory limit; see ``training.loop.train``.
        checkpoint_dir: where a killed training is resumed from.
        logs: folder of the metrics log.
    """

    seed: int
    threads: int
    memory_mb: int | None
    checkpoint_dir: Path
    logs: Path


@dataclass
class Notes:
    """Messages about a training, and the counters that only some options have."""

    decisions: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    counters: dict[str, Any] = field(default_factory=dict)


def train_scene(
    views: list[View],
    manifest: Manifest,
    model: Reconstruction,
    initial: Gaussians,
    config: Train,
    experiments: TrainExperiments,
    run: TrainingRun,
    part: Part = WHOLE_RUN,
    dense: Path | None = None,
) -> TrainedScene:
    """Train on the views that are not test views.

    Args:
        dense: outputs of the stage dense, whose depths the depth loss uses.
        part: of the schedule.

    Raises:
        UserError: see ``training.loop.train``.
    """
    notes = Notes()
    has_alpha = any(photo.alpha for photo in manifest.photos)
    appearance = choose_appearance(
        views,
        model,
        initial.means.double().numpy(),
        config.appearance,
        cameras=[photo.camera_group for photo in manifest.photos],
        has_alpha=has_alpha,
        in_blocks=part != WHOLE_RUN,
    )
    notes.decisions += appearance.decisions
    notes.counters |= appearance.counters
    gains = appearance.gains
    inputs = scene_inputs(views, manifest, model, initial, gains, config, notes, dense)
    if appearance.embeddings:
        size = experiments.appearance_size
        inputs = replace(inputs, embeddings=initial_embeddings(inputs.views, size))
    trained = run_training(
        inputs,
        config,
        experiments,
        run,
        part,
        notes,
    )
    result, refined = trained.result, model
    if result.intrinsics is not None:
        refined = with_intrinsics(refined, result.intrinsics)
        trained.decisions.append(describe_intrinsics(result.intrinsics))
    if result.poses is not None:
        refined = with_poses(refined, with_common_motion(views, result.poses))
        trained.decisions.append(describe_poses(views, result.poses))
    return replace(trained, model=None if refined is model else refined, gains=gains)


def run_training(
    inputs: Inputs,
    config: Train,
    experiments: TrainExperiments,
    run: TrainingRun,
    part: Part = WHOLE_RUN,
    notes: Notes | None = None,
) -> TrainedScene:
    """Train, and describe the result; arguments and errors as ``train_scene``.

    Args:
        notes: messages and counters of the inputs.
    """
    notes = notes or Notes()
    start = time.perf_counter()
    result = train(
        inputs,
        config,
        experiments,
        seed=run.seed,
        threads=run.threads,
        memory_mb=run.memory_mb,
        checkpoint_dir=run.checkpoint_dir,
        metrics_log=run.logs / metrics_log.NAME,
        on_log=lambda text: print(text, file=sys.stderr, flush=True),
        part=part,
    )
    # Seconds that earlier, killed processes spent on this training.
    earlier = max(0.0, result.seconds - (time.perf_counter() - start))
    _describe(result, len(inputs.views), config, part, notes)
    counters = TrainCounters(
        num_gaussians=len(result.gaussians),
        steps=result.steps,
        known_depths=sum(map(len, inputs.depths or ())),
        device="gpu" if config.device.startswith("gpu") else "cpu",
        **notes.counters,
        **result.counters,
    )
    timings = {
        "built": dict(result.built),
        "ms_per_step": round(1e3 * result.seconds / result.steps, 3),
        "curve_seconds": result.curve_seconds,
        "earlier_s": round(earlier, 3),
    }
    return TrainedScene(
        result=result,
        model=None,
        gains=NO_GAINS,
        decisions=notes.decisions,
        warnings=notes.warnings,
        counters=counters,
        timings=timings,
    )


def scene_inputs(
    views: list[View],
    manifest: Manifest,
    model: Reconstruction,
    initial: Gaussians,
    gains: ExposureGains,
    config: Train,
    notes: Notes | None = None,
    dense: Path | None = None,
) -> Inputs:
    """The inputs of training a scene.

    Args:
        gains: of all views; empty if exposure is not modelled.
        notes: receives messages and counters about depth maps.
        dense: outputs of the stage dense; not used beside depth maps of the user.
    """
    notes = notes or Notes()
    training = [view for view in views if not view.is_test]
    points = point_depths(training, model)
    extent = scene_extent(views)
    return Inputs(
        views=training,
        initial=initial,
        extent=extent,
        scale=scene_scale(extent, points),
        gains=np.array([gains.of(view.name) for view in training]) if gains else None,
        depths=(
            _known_depths(training, manifest, points, initial, notes, dense)
            if config.depth_loss_weight
            else None
        ),
        empty_depths=empty_depths(points),
        seen_share=seen_share(initial.means.double().numpy(), training),
    )


def _known_depths(
    views: list[View],
    manifest: Manifest,
    points: list[KnownDepths],
    initial: Gaussians,
    notes: Notes,
    dense: Path | None,
) -> list[KnownDepths]:
    """Depths of the sparse points and of the user's depth maps or of the dense ones, by view."""
    files = {p.name: (p.depth, p.depth_digest) if p.depth else None for p in manifest.photos}
    maps = [files[view.name] for view in views]
    if dense is not None and not any(maps):
        return add_dense_depths(views, points, dense)
    fitted_to, source = points, "sparse points"
    if any(maps) and not any(map(len, points)):
        fitted_to, source = gaussian_depths(views, initial.means.double().numpy()), "Gaussians"
    known, kinds, refused = add_maps(views, points, maps, fitted_to)
    if kinds:
        fits = ", ".join(f"{count} as {FITS[kind]}" for kind, count in kinds.items())
        notes.decisions.append(f"depth maps fitted to the {source}: {fits}")
    if refused:
        notes.warnings.append(
            f"depth maps of {len(refused)} views are not used, because they do not fit the "
            f"{source} or contain too few of them: {', '.join(refused[:5])}"
        )
    notes.counters["depth_maps"] = sum(kinds.values())
    return known


def _describe(result: TrainResult, num_views: int, config: Train, part: Part, notes: Notes) -> None:
    notes.warnings += result.warnings
    minutes = config.budget_minutes
    whole = part == WHOLE_RUN
    if whole and (few := too_few_epochs(result.steps, num_views, result.seconds, minutes)):
        notes.warnings.append(few)
    if minutes is not None:
        notes.decisions.append(
            f"{result.steps} steps fitted into {minutes:g} minutes; the number depends on the "
            "machine and its load, so another run gives other bits"
        )
    if unseen := result.counters["unseen"]:
        notes.decisions.append(f"{unseen} Gaussians that no training view sees were removed")
    if floaters := result.counters["floaters"]:
        notes.decisions.append(f"{floaters} floaters close to cameras were removed")


def too_few_epochs(steps: int, views: int, seconds: float, minutes: float | None) -> str | None:
    """A warning if the run is too short for its number of views, else None."""
    if steps >= MIN_EPOCHS * views:
        return None
    epochs = f"{steps} steps are {steps / views:.1f} epochs over {views} training views"
    if minutes is None:
        return f"{epochs}, too few for a sharp scene: raise train.steps"
    return (
        f"{epochs}, too few for a sharp scene, in {minutes:g} minutes at {seconds / steps:.2g} s a "
        "step: raise train.budget_minutes, lower views.max_long_side_px, or stop other programs on "
        "this machine"
    )
