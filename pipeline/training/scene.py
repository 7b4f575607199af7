"""Training of a scene: prepares the inputs, runs the optimisation and describes the result."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

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
from pipeline.training.few_views import few_views_lines
from pipeline.training.loop.counters import TrainCounters
from pipeline.training.loop.result import TrainResult
from pipeline.training.loop.train import train
from pipeline.training.run import TrainingRun

# A warning says that a training of fewer epochs (passes over its views) is short.
MIN_EPOCHS = 3.0
FITS = {
    "factor": "depths of unknown scale",
    "depth": "depths of unknown scale and shift",
    "inverse": "inverse depths of unknown scale and shift",
}


@dataclass
class TrainedScene:
    """A finished training.

    Attributes:
        model: The reconstruction with refined cameras; None if none was refined.
        gains: The exposure gains of all views; empty if exposure is not modelled.
        decisions, warnings, counters: What ``stage.json`` records.
        timings: What ``run.json`` records.
    """

    result: TrainResult
    model: Reconstruction | None
    gains: ExposureGains
    decisions: list[str]
    warnings: list[str]
    counters: TrainCounters
    timings: dict[str, Any]


@dataclass(frozen=True)
class SceneData:
    """A scene as the stages before training describe it: all views, test views as well."""

    views: list[View]
    manifest: Manifest
    model: Reconstruction


@dataclass
class Notes:
    """Messages about a training, and the counters that only some options have."""

    decisions: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    counters: dict[str, Any] = field(default_factory=dict)


def train_scene(
    scene: SceneData, initial: Gaussians, run: TrainingRun, dense: Path | None = None
) -> TrainedScene:
    """Train on the views that are not test views.

    Args:
        dense: The folder with the dense stage's depth maps. Ignored if the user gave depth maps.

    Raises:
        UserError: As ``training.loop.train.train``.
    """
    notes, manifest = Notes(), scene.manifest
    appearance = choose_appearance(
        scene.views,
        scene.model,
        initial.means.double().numpy(),
        run.options.appearance,
        cameras={photo.name: photo.camera_group for photo in manifest.photos},
        has_alpha=any(photo.alpha for photo in manifest.photos),
        in_blocks=run.is_part,
    )
    notes.decisions += appearance.decisions
    notes.counters |= appearance.counters
    inputs = scene_inputs(scene, initial, run, appearance.gains, notes, dense)
    gains = appearance.gains
    if appearance.embeddings:
        size = run.options.experiments.appearance_size
        start = initial_embeddings(
            inputs.views, scene.model, initial.means.double().numpy(), inputs.gains, size
        )
        # Gains are then a part of the appearance (``Appearance.gains``).
        inputs, gains = replace(inputs, embeddings=start), appearance.shading
    trained = run_training(inputs, run, notes)
    result, refined = trained.result, scene.model
    if result.intrinsics is not None:
        refined = with_intrinsics(refined, result.intrinsics)
        trained.decisions.append(describe_intrinsics(result.intrinsics))
    if result.poses is not None:
        refined = with_poses(refined, with_common_motion(scene.views, result.poses))
        trained.decisions.append(describe_poses(scene.views, result.poses))
    model = None if refined is scene.model else refined
    return replace(trained, model=model, gains=gains)


def run_training(inputs: Inputs, run: TrainingRun, notes: Notes | None = None) -> TrainedScene:
    """Train, and describe the result.

    Args:
        notes: Messages and counters of the inputs.

    Raises:
        UserError: As ``training.loop.train.train``.
    """
    notes = notes or Notes()
    start = time.perf_counter()
    result = train(inputs, run, log=lambda text: print(text, file=sys.stderr, flush=True))
    # Seconds that earlier, killed processes spent on this training.
    earlier = max(0.0, result.seconds - (time.perf_counter() - start))
    _describe(result, len(inputs.views), run, notes)
    notes.decisions += transients_lines(result, inputs.views)
    counters = TrainCounters(
        num_gaussians=len(result.gaussians),
        steps=result.steps,
        known_depths=sum(map(len, inputs.depths or ())),
        device="gpu" if run.options.device.startswith("gpu") else "cpu",
        **_transient_counters(result, inputs.views),
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
    scene: SceneData,
    initial: Gaussians,
    run: TrainingRun,
    gains: ExposureGains,
    notes: Notes | None = None,
    dense: Path | None = None,
) -> Inputs:
    """The inputs of training a scene.

    Args:
        gains: The gains of all views; empty if exposure is not modelled.
        notes: Receives messages and counters about depth maps.
        dense: See ``train_scene``.
    """
    notes = notes or Notes()
    training = [view for view in scene.views if not view.is_test]
    points = point_depths(training, scene.model)
    extent = scene_extent(scene.views)
    return Inputs(
        views=training,
        initial=initial,
        extent=extent,
        scale=scene_scale(extent, points),
        light=gains.of_all(view.name for view in training),
        depths=(
            _known_depths(training, scene.manifest, points, initial, notes, dense)
            if run.options.depth_loss_weight
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


def _describe(result: TrainResult, num_views: int, run: TrainingRun, notes: Notes) -> None:
    notes.warnings += result.warnings
    if not run.is_part:
        notes.decisions += few_views_lines(run.options, num_views, result.early_fit)
    minutes = run.options.budget_minutes
    if not run.is_part and (
        few := too_few_epochs(result.steps, num_views, result.seconds, minutes)
    ):
        notes.warnings.append(few)
    if minutes is not None:
        notes.decisions.append(
            f"{result.steps} steps fitted into {minutes:g} minutes; the number depends on the "
            "machine and its load, so another run differs a little"
        )
    if unseen := result.counters["unseen"]:
        notes.decisions.append(f"{unseen} Gaussians that no training view sees were removed")
    if floaters := result.counters["floaters"]:
        notes.decisions.append(f"{floaters} floaters close to cameras were removed")


def transients_lines(result: TrainResult, views: Sequence[View]) -> list[str]:
    """What ``stage.json`` says about transients in the training ``views``; empty without any."""
    if not result.transients:
        return []
    share = _transient_counters(result, views)["transient_share"]
    return [
        f"passers-by: {len(result.transients)} of {len(views)} views show something that the "
        f"others contradict ({share:.1%} of the pixels): left out of the loss (train.transients)"
    ]


def _transient_counters(result: TrainResult, views: Sequence[View]) -> dict[str, Any]:
    if result.transients is None:
        return {}
    pixels = sum(view.width * view.height for view in views)
    hidden = sum(int(mask.sum()) for mask in result.transients.values())
    return {
        "transient_views": len(result.transients),
        "transient_share": round(hidden / max(1, pixels), 5),
    }


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
