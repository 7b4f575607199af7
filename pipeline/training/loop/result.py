"""The result of training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.scene.appearance import Appearance
from pipeline.splats.gaussians import Gaussians
from pipeline.training.few_views import EarlyFit
from pipeline.training.loop.curve import TrainingCurve
from pipeline.training.loop.setup import TrainingScene
from pipeline.training.loop.state import TrainState


@dataclass(frozen=True)
class TrainResult:
    """A trained scene.

    Attributes:
        gaussians: The Gaussians with SH of the configured degree, in the colours of the mean
            photograph.
        curve: The training curve, which is deterministic.
        curve_seconds: The training time of each record; differs between runs.
        counters: The totals of the run (``state.Counters``).
        near: The near plane of the training, world units; renders need the same.
        background: The background of the training: black, white or random.
        warnings: The warnings for the user; deterministic.
        steps: The number of optimiser steps.
        seconds: The training time in all processes of the run.
        built: ``Backend.facts`` of the last process.
        poses: (4, 4) refined world to camera of each view by name, or None.
        intrinsics: (3,) change of each camera's intrinsics by id
            (``cameras.intrinsics.IntrinsicsRefinement``), or None.
        appearance: The appearance of the Gaussians in the training views, or None.
        early_fit: The fit while one view was held back; None if none was.
        transients: (H, W) bool at the size of the view, true for what was left out of the loss, by
            the names of the views that show any; None if it was not searched for.
    """

    gaussians: Gaussians
    curve: TrainingCurve
    curve_seconds: list[float]
    counters: dict[str, Any]
    near: float
    background: str
    warnings: list[str]
    steps: int
    seconds: float
    built: Mapping[str, str]
    poses: dict[str, NDArray[np.float64]] | None
    intrinsics: dict[int, NDArray[np.float64]] | None
    appearance: Appearance | None
    early_fit: EarlyFit | None
    transients: dict[str, NDArray[np.bool_]] | None


def result_of(
    state: TrainState,
    scene: TrainingScene,
    sh_degree: int,
    warnings: list[str],
    built: Mapping[str, str],
) -> TrainResult:
    """The result of a finished training."""
    poses, intrinsics = state.cameras.poses, state.cameras.intrinsics
    names = [view.name for view in scene.views]
    gaussians, appearance = state.gaussians, None
    if state.appearance is not None:
        gaussians, appearance = state.appearance.centred(gaussians, names, scene.inputs.gains)
    return TrainResult(
        gaussians=gaussians.with_sh_degree(sh_degree),
        curve=TrainingCurve(tuple(state.curve)),
        curve_seconds=state.curve_seconds,
        counters=asdict(state.counters),
        near=scene.near,
        background=scene.background,
        warnings=warnings,
        steps=state.step,
        seconds=state.seconds,
        built=built,
        poses=None if poses is None else dict(zip(names, poses.poses, strict=True)),
        intrinsics=None if intrinsics is None else intrinsics.by_id(),
        appearance=appearance,
        early_fit=state.early_fit,
        transients=None if state.transients is None else state.transients.by_name(scene.views),
    )
