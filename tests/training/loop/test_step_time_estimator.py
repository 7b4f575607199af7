"""The estimate of the number of steps that fit into a time budget."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.training.loop import clock, session
from pipeline.training.loop.step_time_estimator import FULL_STEP, INTERVAL, StepTimeEstimator
from tests.training.conftest import TinyScene, tiny_config
from tests.training.loop.test_trainer import run


def measure(
    found: StepTimeEstimator, each: float, factor: int, steps: int, begin: int, at: float
) -> float:
    for step in range(begin, begin + steps + 1):
        found.observe(step, at + (step - begin) * each, factor)
    return at + steps * each


def test_before_the_first_measurement_the_default_is_returned() -> None:
    found = StepTimeEstimator(60.0)
    measure(found, 0.1, 1, INTERVAL - 1, 0, 0.0)
    assert found.steps(INTERVAL - 1, 1.9, default=7000) == 7000


def test_remaining_steps_take_the_recent_time_per_step() -> None:
    found = StepTimeEstimator(60.0)
    seconds = measure(found, 0.1, 1, 200, 0, 0.0)
    assert found.steps(200, seconds, 7000) == pytest.approx(600)
    # Slower for many intervals: older measurements have no weight.
    seconds = measure(found, 0.2, 1, 200, 200, seconds)
    assert found.steps(400, seconds, 7000) == pytest.approx(400 + 0, abs=2)
    assert found.steps(400, 61.0, 7000) == 400


@pytest.mark.parametrize("factor", [2, 4])
def test_steps_at_reduced_resolution_are_scaled_to_full_resolution(factor: int) -> None:
    found = StepTimeEstimator(60.0)
    seconds = measure(found, 0.1 / FULL_STEP[factor], factor, 100, 0, 0.0)
    assert found.steps(100, seconds, 7000) == pytest.approx(100 + (60 - seconds) / 0.1)


def test_one_slow_interval_changes_the_estimate_little() -> None:
    """Such as one in which a checkpoint is written."""
    found = StepTimeEstimator(600.0)
    seconds = measure(found, 0.1, 1, 200, 0, 0.0)
    seconds = measure(found, 0.2, 1, INTERVAL, 200, seconds)
    assert found.steps(200 + INTERVAL, seconds, 7000) > 4500


def test_a_time_budget_limits_the_gaussians_to_what_its_steps_can_train(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks = itertools.count()
    monkeypatch.setattr(session, "time", SimpleNamespace(monotonic=lambda: 0.01 * next(looks)))
    monkeypatch.setattr(clock, "GAUSSIANS_PER_STEP", 0.35)  # of 200 steps
    config = tiny_config(budget_minutes=2 / 60, density={"max_gaussians": 120})
    result = run(scene, tmp_path, config)
    assert 65 <= result.counters["max_gaussians"] <= 75
