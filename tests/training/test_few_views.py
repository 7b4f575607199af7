"""Drop-out of Gaussians: what is drawn, the gradients of the opacities, and which runs use it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.config.experiments import TrainExperiments
from pipeline.config.settled import Train, TrainOptions
from pipeline.training import few_views
from pipeline.training.data.inputs import Inputs
from pipeline.training.few_views import (
    DROPPED_LOGIT,
    FEW_VIEWS,
    SHARE,
    EarlyFit,
    central_view,
    dropout_of,
    few_views_lines,
    held_back_steps,
    sh_degree_of,
    thinned,
)
from pipeline.training.loop import operator_step
from pipeline.training.loop.result import TrainResult
from pipeline.training.loop.schedule import Schedule
from pipeline.training.loop.train import train
from pipeline.training.run import TrainingRun
from tests.training.conftest import TinyScene, camera_at, killed_in_step, tiny_config


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


def test_the_view_in_the_middle_is_held_back() -> None:
    # An arc, in an order that is not that of the places.
    angles = np.linspace(-0.8, 0.8, 7)[[3, 0, 6, 1, 5, 2, 4]]
    assert central_view([camera_at(angle) for angle in angles]) == 0
    assert held_back_steps(options_of(), 5) == 0  # Too few to do without one.
    assert held_back_steps(options_of(), 6) == held_back_steps(options_of(), FEW_VIEWS) > 0
    assert held_back_steps(options_of(), FEW_VIEWS + 1) == 0
    assert held_back_steps(options_of(dropout=0.2), 6) == 0  # Configured.


@pytest.mark.parametrize(
    ("held_back", "others", "exact"), [(35.6, 36.2, True), (28.2, 38, False), (36, 26.3, False)]
)
def test_nothing_is_dropped_where_the_early_fit_is_exact(
    held_back: float, others: float, exact: bool
) -> None:
    found = EarlyFit(held_back, others)
    assert found.is_exact == exact
    said = few_views_lines(options_of(), 10, found)[0]
    assert f"{held_back:.1f} dB" in said and ("not drawn" in said) != exact


STEPS = 300


def trained(scene: TinyScene, folder: Path) -> TrainResult:
    run = TrainingRun(tiny_config(STEPS, dropout=None), folder, seed=3)
    return train(Inputs(scene.views, scene.initial, scene.extent), run)


def test_the_run_decides_by_the_view_that_it_holds_back(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shares, original = set(), operator_step.OperatorStep.step

    def noted(engine: operator_step.OperatorStep, step: operator_step.Step) -> object:
        shares.add((step.dropped_share > 0, step.view.index))
        return original(engine, step)

    monkeypatch.setattr(operator_step.OperatorStep, "step", noted)
    found = trained(scene, tmp_path / "first").early_fit
    assert found is not None and not found.is_exact and found.held_back < found.others
    assert {index for dropped, index in shares if dropped} == set(range(6))
    held_back = central_view(scene.views)
    assert (False, held_back) not in shares and len(shares) == 11
    shares.clear()
    monkeypatch.setattr(few_views, "EXACT", found.held_back)
    found = trained(scene, tmp_path / "exact").early_fit
    assert found is not None and found.is_exact
    assert not any(dropped for dropped, _ in shares)


@pytest.mark.parametrize("step", [74, 75, 76, 77, 200])
def test_a_run_killed_around_the_decision_gives_the_same_bits(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    whole = trained(scene, tmp_path / "whole")
    with killed_in_step(monkeypatch, step):
        trained(scene, tmp_path / "cut")
    resumed = trained(scene, tmp_path / "cut")
    assert resumed.early_fit == whole.early_fit and resumed.curve == whole.curve
    for name, tensor in whole.gaussians.tensors().items():
        assert torch.equal(tensor, resumed.gaussians.tensors()[name]), name
