"""Drop-out of Gaussians: what is drawn, and the gradients of the opacities."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.config.experiments import TrainExperiments
from pipeline.config.settled import Train, TrainOptions
from pipeline.training.dropout import DROPPED_LOGIT, FEW_VIEWS, SHARE, dropout_of, thinned
from pipeline.training.run import Part, TrainingRun


def rng() -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(0))


@pytest.mark.parametrize("share", [0.05, 0.2, 0.9])
def test_the_share_is_dropped_and_the_mean_opacity_stays(share: float) -> None:
    opacity = torch.linspace(0.001, 0.99 * (1 - share), 20_000)
    found = torch.sigmoid(thinned(torch.logit(opacity), share, rng()).logits)
    dropped = found < 1e-8
    assert dropped.float().mean() == pytest.approx(share, abs=0.01)
    assert torch.allclose(found[~dropped] * (1 - share), opacity[~dropped], atol=1e-6)
    assert found.mean() == pytest.approx(opacity.mean().item(), rel=0.03)


def test_the_derivative_equals_finite_differences() -> None:
    logits = torch.linspace(-6, 8, 400, dtype=torch.float64)
    found = thinned(logits, 0.2, rng())
    step = 1e-6
    change = thinned(logits + step, 0.2, rng()).logits - thinned(logits - step, 0.2, rng()).logits
    below = torch.sigmoid(logits) < 4 / 9
    assert torch.allclose(found.derivative[below], change[below] / (2 * step), atol=1e-6)
    # Opaque Gaussians, at the upper bound when they are raised, keep a gradient.
    kept = found.logits > DROPPED_LOGIT
    assert (found.derivative[kept] > 0).all() and found.derivative.max() == 1 / 0.8
    assert torch.isfinite(found.logits).all()


def test_only_few_training_views_drop_gaussians() -> None:
    def share(views: int, part: Part | None = None, **experiments: float) -> float:
        options = dict(Train()) | {"experiments": TrainExperiments(**experiments)}
        parts = {} if part is None else {"part": part}
        return dropout_of(TrainingRun(TrainOptions(**options), Path(), **parts), views)

    assert share(3) == share(FEW_VIEWS) == SHARE
    assert share(FEW_VIEWS + 1) == share(FEW_VIEWS, Part(0, 0.5)) == 0
    assert share(3, dropout=0.0) == 0 and share(100, dropout=0.5) == 0.5
