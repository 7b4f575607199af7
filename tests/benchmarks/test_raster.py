"""The rasterizer's benchmark runs what training runs."""

from __future__ import annotations

from benchmarks.raster.measure import Step
from benchmarks.raster.scenes import synthetic


def test_every_operator_of_a_step_is_timed() -> None:
    times = Step(synthetic(500, 96, 54, 5.0), threads=2).once()
    parts = [name for name in times if name != "step"]
    assert len(parts) == 7
    assert times["step"].wall == sum(times[name].wall for name in parts) > 0
