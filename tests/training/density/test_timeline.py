"""When density strategies act: phases of runs of any length, and 3DGS's published steps."""

from __future__ import annotations

import pytest

from pipeline.config.experiments import GradientExperiments
from pipeline.training.density.gradient import GradientDensity
from pipeline.training.density.original import OriginalDensity

PUBLISHED_STEPS = 30_000


def after(hook: object, steps: int = PUBLISHED_STEPS) -> list[int]:
    """The steps after which ``hook`` is true."""
    return [step for step in range(1, steps + 1) if hook(step)]  # type: ignore[operator]


@pytest.mark.parametrize("steps", [1, 10, 60, 600, 2000, 7000, 30_000])
def test_density_control_fits_into_the_run(steps: int) -> None:
    density = GradientDensity(GradientExperiments(), steps, scale=1.0)
    timeline = density.timeline
    densified = after(timeline.densifies_after, steps)
    assert all(step <= timeline.stop for step in densified)
    resets = after(density.resets_opacity_after, steps)
    assert all(step + density.reset_interval <= timeline.stop for step in resets)
    assert not timeline.prunes_after(steps)
    if steps >= 600:
        assert len(densified) >= 10


def test_opacity_resets_leave_an_interval_to_recover() -> None:
    density = GradientDensity(GradientExperiments(stop_share=0.5), PUBLISHED_STEPS, scale=1.0)
    assert after(density.resets_opacity_after) == [3000, 6000, 9000, 12_000]
    large = after(density.prunes_large_after)
    assert (large[0], large[-1]) == (3100, 15_000)


def test_short_runs_never_prune_large_gaussians() -> None:
    """Without an opacity reset, large Gaussians of the background are not yet split."""
    density = GradientDensity(GradientExperiments(), 4000, scale=1.0)
    assert not after(density.prunes_large_after, 4000)


def test_the_published_timeline() -> None:
    """Every 100 steps after step 500 and before 15 000; resets every 3000 of these steps."""
    density = OriginalDensity(PUBLISHED_STEPS, extent=1.0)
    assert after(density.timeline.densifies_after) == list(range(600, 15_000, 100))
    assert not after(density.timeline.prunes_after)
    assert after(density.resets_opacity_after) == [3000, 6000, 9000, 12_000]
    assert not density.prunes_large_after(3000) and density.prunes_large_after(3001)
    # The authors' shorter run stops within the same timeline.
    short = OriginalDensity(7000, extent=1.0)
    assert after(short.timeline.densifies_after, 7000) == list(range(600, 7001, 100))
    assert after(short.resets_opacity_after, 7000) == [3000, 6000]
