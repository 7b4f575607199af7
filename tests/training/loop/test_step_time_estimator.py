"""How many steps a run by the clock will come to, from how fast it goes."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.training.loop import trainer
from pipeline.training.loop.step_time_estimator import FULL_STEP, LAP, Pace
from tests.training.conftest import TinyScene, tiny_config
from tests.training.loop.test_trainer import run


def going(found: Pace, each: float, factor: int, steps: int, begin: int, at: float) -> float:
    for step in range(begin, begin + steps + 1):
        found.passes(step, at + (step - begin) * each, factor)
    return at + steps * each


def test_nobody_knows_before_the_first_lap() -> None:
    found = Pace(60.0)
    going(found, 0.1, 1, LAP - 1, 0, 0.0)
    assert found.steps(LAP - 1, 1.9, unknown=7000) == 7000


def test_the_rest_goes_on_as_now() -> None:
    found = Pace(60.0)
    seconds = going(found, 0.1, 1, 200, 0, 0.0)
    assert found.steps(200, seconds, 7000) == pytest.approx(600)
    # Slower for long: what was before is forgotten.
    seconds = going(found, 0.2, 1, 200, 200, seconds)
    assert found.steps(400, seconds, 7000) == pytest.approx(400 + 0, abs=2)
    assert found.steps(400, 61.0, 7000) == 400


@pytest.mark.parametrize("factor", [2, 4])
def test_a_small_picture_says_what_a_large_one_will_take(factor: int) -> None:
    found = Pace(60.0)
    seconds = going(found, 0.1 / FULL_STEP[factor], factor, 100, 0, 0.0)
    assert found.steps(100, seconds, 7000) == pytest.approx(100 + (60 - seconds) / 0.1)


def test_one_slow_lap_changes_little() -> None:
    """A checkpoint is written every half minute."""
    found = Pace(600.0)
    seconds = going(found, 0.1, 1, 200, 0, 0.0)
    seconds = going(found, 0.2, 1, LAP, 200, seconds)
    assert found.steps(200 + LAP, seconds, 7000) > 4500


def test_a_run_by_the_clock_has_no_more_gaussians_than_its_steps_can_train(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks = itertools.count()
    monkeypatch.setattr(trainer, "time", SimpleNamespace(monotonic=lambda: 0.01 * next(looks)))
    monkeypatch.setattr(trainer, "GAUSSIANS_A_STEP", 0.35)  # of 200 steps
    config = tiny_config(budget_minutes=2 / 60, density={"max_gaussians": 120})
    result = run(scene, tmp_path, config)
    assert 65 <= result.counters["max_gaussians"] <= 75
