"""Drop-out of Gaussians: what is drawn, and the gradients of the opacities."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.config.experiments import TrainExperiments
from pipeline.config.settled import Train, TrainOptions
from pipeline.training.few_views import (
    DROPPED_LOGIT,
    FEW_VIEWS,
    SHARE,
    dropout_of,
    few_views_lines,
    sh_degree_of,
    thinned,
)
from pipeline.training.loop.schedule import Schedule


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


def options_of(**experiments: float) -> TrainOptions:
    return TrainOptions(**dict(Train()) | {"experiments": TrainExperiments(**experiments)})


def test_only_few_training_views_drop_gaussians() -> None:
    assert dropout_of(options_of(), 3) == dropout_of(options_of(), FEW_VIEWS) == SHARE
    assert dropout_of(options_of(), FEW_VIEWS + 1) == 0
    assert dropout_of(options_of().model_copy(update={"refine_poses": True}), 3) == 0
    assert dropout_of(options_of().model_copy(update={"steps": 50 * 17 - 1}), 17) == 0
    assert dropout_of(options_of(dropout=0.0), 3) == 0
    assert dropout_of(options_of(dropout=0.5), 100) == 0.5
    assert Schedule.of(options_of(), views=3).dropped_share_at(Train().steps) == SHARE
    assert Schedule.of(options_of()).dropped_share_at(Train().steps) == 0  # A block.


@pytest.mark.parametrize(("views", "degree"), [(3, 0), (4, 1), (8, 1), (9, 2), (15, 2), (16, 3)])
def test_spherical_harmonics_have_no_more_coefficients_than_views(views: int, degree: int) -> None:
    assert sh_degree_of(options_of(), views) == degree
    assert Schedule.of(options_of(), views=views).sh_degree_at(Train().steps) == degree
    assert sh_degree_of(options_of(views_per_sh_coefficient=0.0), views) == 3
    assert any(
        f"harmonics is {degree}" in line for line in few_views_lines(options_of(), views)
    ) == (degree < 3)
