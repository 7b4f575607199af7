"""The schedule of runs of any length: phases, learning rates, the limit of Gaussians."""

from __future__ import annotations

from typing import Any

import pytest

from pipeline.config.density import Gradient
from pipeline.config.experiments import TrainExperiments
from pipeline.config.settled import Train, TrainOptions
from pipeline.training.loop.schedule import CAMERA_DECAY, Schedule


def schedule_of(train: Train | None = None, **experiments: Any) -> Schedule:
    options = dict(train or Train()) | {"experiments": TrainExperiments(**experiments)}
    return Schedule.of(TrainOptions(**options))


@pytest.mark.parametrize("steps", [1, 10, 60, 600, 2000, 7000, 30_000])
def test_phases_fit_into_the_run(steps: int) -> None:
    schedule = schedule_of(Train(steps=steps))
    every = range(1, steps + 1)
    factors = [schedule.resolution_factor(step) for step in every]
    assert factors == sorted(factors, reverse=True)
    assert factors[-1] == 1
    degrees = [schedule.sh_degree_at(step) for step in every]
    assert degrees == sorted(degrees)
    if steps >= 600:
        assert degrees[-1] == 3
        assert set(factors) == {1, 2, 4}


def test_the_means_learning_rate_decays_log_linearly() -> None:
    rates = {"means_learning_rate": 1e-2, "means_final_learning_rate": 1e-4}
    schedule = schedule_of(Train(steps=101), **rates, learning_rate_factor=1.0)
    for step, rate in ((1, 1e-2), (51, 1e-3), (101, 1e-4)):
        assert schedule.learning_rates(step, 101, unit=2.0).means == pytest.approx(2 * rate)


def test_learning_rates_are_higher_in_short_runs_and_decay_at_the_end() -> None:
    ends = {"learning_rate_decay_start": 0.5, "learning_rate_final_factor": 0.1}
    schedule = schedule_of(Train(steps=3000), **ends)
    assert schedule.learning_rate_factor(3000) == pytest.approx(10**0.5)
    decays = [schedule.decay_at(step) for step in range(1, 3001)]
    assert decays[0] == decays[1499] == 1.0
    assert decays == sorted(decays, reverse=True)
    assert decays[-1] == pytest.approx(0.1)
    papers = schedule_of(Train(steps=30_000), learning_rate_final_factor=1.0)
    assert papers.learning_rate_factor(30_000) == papers.learning_rate_factor(60_000) == 1.0
    assert {papers.decay_at(step) for step in (1, 15_000, 30_000)} == {1.0}
    assert papers.learning_rate_factor(10) == 4.0
    assert schedule_of(learning_rate_factor=1.5).learning_rate_factor(100) == 1.5


def test_the_limit_of_gaussians_grows_with_the_resolution() -> None:
    schedule = schedule_of(Train(density=Gradient(max_gaussians=1000)), coarse_share=0.5)
    budgets = [schedule.budget_at(step) for step in range(1, Train().steps + 1)]
    assert budgets == sorted(budgets)
    assert set(budgets) == {500, 707, 1000}


def test_a_time_budget_is_coarse_for_a_share_of_its_time() -> None:
    """Coarse steps are fast: a share of the time is a larger share of the steps."""
    by_steps, by_minutes = schedule_of(Train(steps=1000)), schedule_of(Train(budget_minutes=1))
    assert by_steps.coarse_steps == 150
    assert by_minutes.coarse_steps / by_minutes.steps == pytest.approx(0.1)
    assert schedule_of(Train(steps=1000), coarse_share=0.0).coarse_steps == 0
    long = schedule_of(Train(budget_minutes=24))
    assert long.coarse_steps / long.steps == pytest.approx(0.05, abs=1e-3)


@pytest.mark.parametrize(("steps", "views"), [(4000, 50), (1500, 3)])
def test_the_learning_rates_of_a_camera_sum_to_its_limit(steps: int, views: int) -> None:
    schedule = schedule_of(Train(steps=steps))
    rates = [schedule.camera_rate(step, steps / views) for step in range(1, steps + 1)]
    assert sum(rates) / views == pytest.approx(1.0, rel=1e-2)
    assert rates[-1] == pytest.approx(CAMERA_DECAY * rates[0], rel=1e-2)


@pytest.mark.parametrize("seen, factor", [(1.0, 4.0), (0.5, 4.0), (0.125, 2.0), (0.001, 1.0)])
def test_learning_rates_are_lower_where_few_views_see_a_gaussian(
    seen: float, factor: float
) -> None:
    """Its steps would be larger than those of others, and scenes of hundreds of views diverge."""
    schedule = Schedule.of(TrainOptions(steps=1500), seen)
    assert schedule.learning_rate_factor(1500) == pytest.approx(factor)
    assert schedule.learning_rate_factor(30_000) == 1.0
