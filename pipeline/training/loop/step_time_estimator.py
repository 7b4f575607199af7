"""Estimates the number of steps that fit into a time budget, from the measured time per step."""

from __future__ import annotations

from dataclasses import dataclass

#: Steps of one measurement, and the weight of the newest in the moving average.
INTERVAL, NEWEST_WEIGHT = 20, 0.3
#: Time of a step at full resolution over that at 1 / factor: less than the ratio of pixels, since
#: every Gaussian takes time.
FULL_STEP = {1: 1.0, 2: 3.0, 4: 9.0}
#: Gaussians that one optimiser step of a run can train.
GAUSSIANS_PER_STEP = 30


@dataclass
class StepTimeEstimator:
    """The estimate of one process; a resumed run measures again.

    Attributes:
        budget: The seconds of the whole run.
        step_seconds: The time of a step at full resolution; 0 before the first measurement.
        started: The step, seconds and resolution factor at the start of the current measurement.
    """

    budget: float
    step_seconds: float = 0.0
    started: tuple[int, float, int] | None = None

    def observe(self, step: int, seconds: float, factor: int) -> None:
        """After ``step`` steps and ``seconds`` of training; ``factor`` is that of the next step."""
        if self.started is None or self.started[2] != factor:
            self.started = step, seconds, factor
        elif step - self.started[0] >= INTERVAL:
            newest = (seconds - self.started[1]) / (step - self.started[0]) * FULL_STEP[factor]
            weight = NEWEST_WEIGHT if self.step_seconds else 1.0
            self.step_seconds += (newest - self.step_seconds) * weight
            self.started = step, seconds, factor

    def steps(self, step: int, seconds: float, default: float) -> float:
        """Estimated steps of the whole run; ``default`` before the first measurement."""
        if not self.step_seconds:
            return default
        return step + max(0.0, self.budget - seconds) / self.step_seconds
