"""Every length of run passes through the same phases, in an order that makes sense."""

from __future__ import annotations

import pytest

from pipeline.config.schema import Density, Train
from pipeline.training.loop.schedule import POSE_FALL, Schedule


@pytest.mark.parametrize("steps", [1, 10, 60, 600, 2000, 7000, 30_000])
def test_phases_fit_into_the_run(steps: int) -> None:
    schedule = Schedule.of(Train(steps=steps))
    every = range(1, steps + 1)
    factors = [schedule.resolution_factor(step) for step in every]
    assert factors == sorted(factors, reverse=True)
    assert factors[-1] == 1
    degrees = [schedule.sh_degree_at(step) for step in every]
    assert degrees == sorted(degrees)
    refines = [step for step in every if schedule.refines_after(step)]
    resets = [step for step in every if schedule.resets_opacity_after(step)]
    assert all(step <= schedule.refine_stop for step in refines)
    assert all(step + schedule.reset_interval <= schedule.refine_stop for step in resets)
    assert not schedule.prunes_after(steps)
    if steps >= 600:
        assert degrees[-1] == 3
        assert len(refines) >= 10
        assert set(factors) == {1, 2, 4}


def test_rates_decay_log_linearly() -> None:
    schedule = Schedule.of(Train(steps=101, lr_means=1e-2, lr_means_final=1e-4))
    assert schedule.lr_means_at(1) == pytest.approx(1e-2)
    assert schedule.lr_means_at(51) == pytest.approx(1e-3)
    assert schedule.lr_means_at(101) == pytest.approx(1e-4)


def test_opacity_resets_of_the_papers_protocol() -> None:
    schedule = Schedule.of(Train(steps=30_000, density=Density(stop_share=0.5)))
    resets = [step for step in range(1, 30_001) if schedule.resets_opacity_after(step)]
    assert resets == [3000, 6000, 9000, 12_000]
    huge = [step for step in range(1, 30_001) if schedule.prunes_huge_after(step)]
    assert (huge[0], huge[-1]) == (3100, 15_000)


def test_short_runs_keep_their_large_backgrounds() -> None:
    """Without a reset, huge Gaussians are not yet split; pruning them cost 8 dB on a room."""
    schedule = Schedule.of(Train())
    assert not any(schedule.prunes_huge_after(step) for step in range(1, Train().steps + 1))


def test_rates_are_boosted_in_short_runs_and_fall_at_the_end() -> None:
    schedule = Schedule.of(Train(steps=3000, lr_decay_from=0.5, lr_final_share=0.1))
    assert schedule.lr_boost_of(3000) == pytest.approx(10**0.5)
    decays = [schedule.lr_decay_at(step) for step in range(1, 3001)]
    assert decays[0] == decays[1499] == 1.0
    assert decays == sorted(decays, reverse=True)
    assert decays[-1] == pytest.approx(0.1)
    papers = Schedule.of(Train(steps=30_000, lr_final_share=1.0))
    assert papers.lr_boost_of(30_000) == papers.lr_boost_of(60_000) == 1.0
    assert {papers.lr_decay_at(step) for step in (1, 15_000, 30_000)} == {1.0}
    assert papers.lr_boost_of(10) == 4.0
    assert Schedule.of(Train(lr_boost=1.5)).lr_boost_of(100) == 1.5


def test_the_budget_grows_with_the_pictures() -> None:
    schedule = Schedule.of(Train(coarse_until=0.5, density=Density(max_gaussians=1000)))
    budgets = [schedule.budget_at(step) for step in range(1, Train().steps + 1)]
    assert budgets == sorted(budgets)
    assert set(budgets) == {500, 707, 1000}


def test_a_run_of_minutes_is_coarse_for_a_share_of_its_time() -> None:
    """Coarse steps take little of it: a share of the time is a larger one of the steps."""
    by_steps, by_minutes = Schedule.of(Train(steps=1000)), Schedule.of(Train(budget_minutes=1))
    assert by_steps.coarse_steps == 150
    assert by_minutes.coarse_steps / by_minutes.steps == pytest.approx(0.1)
    assert Schedule.of(Train(steps=1000, coarse_until=0.0)).coarse_steps == 0
    long = Schedule.of(Train(budget_minutes=24))  # many minutes want detail, too
    assert long.coarse_steps / long.steps == pytest.approx(0.05, abs=1e-3)


@pytest.mark.parametrize(("steps", "views"), [(4000, 50), (1500, 3)])
def test_a_cameras_steps_add_up_to_its_reach(steps: int, views: int) -> None:
    schedule = Schedule.of(Train(steps=steps))
    looks = steps / views
    shares = [schedule.camera_step_at(step, looks) for step in range(1, steps + 1)]
    assert sum(shares) / views == pytest.approx(1.0, rel=1e-2)
    assert shares[-1] == pytest.approx(POSE_FALL * shares[0], rel=1e-2)
