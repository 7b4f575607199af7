"""The position of a run in its schedule, by steps or by time."""

from __future__ import annotations

from pipeline.training.loop.state import TrainState
from pipeline.training.loop.step_time_estimator import GAUSSIANS_PER_STEP, StepTimeEstimator


class Clock:
    """Advances ``TrainState.clock``: by one with each step or, with a time budget, by the share of
    the time that has passed.

    Args:
        steps: The length of the schedule.
        minutes: The time budget; None for a run of ``steps`` optimiser steps.
        part: The first step of the schedule, counted from 0, and the step after the last.
    """

    def __init__(self, steps: int, minutes: float | None, part: range):
        self.steps, self.part = steps, part
        self.estimator = None if minutes is None else StepTimeEstimator(60 * minutes)

    def advance(self, state: TrainState) -> range:
        """Begin an optimiser step; returns the steps of the schedule that it covers."""
        state.step += 1
        before, state.clock = state.clock, self.part.start + state.step
        if self.estimator is not None:
            reached = int(len(self.part) * state.seconds / self.estimator.budget)
            state.clock = self.part.start + max(1, min(len(self.part), reached))
            state.clock = max(before, state.clock)
        return range(before + 1, state.clock + 1)

    def observe(self, state: TrainState, factor: int) -> None:
        """Measure the time of the step before; ``factor`` reduces the images of the next one."""
        if self.estimator is not None:
            self.estimator.observe(state.step - 1, state.seconds, factor)

    def run_length(self, state: TrainState) -> float:
        """Number of optimiser steps of the run, for learning rates. With a time budget: by the mean
        time per step so far. The first steps, at reduced resolution, are fast, so that learning
        rates begin low."""
        if self.estimator is None:
            return self.steps
        return state.step * self.steps / (state.clock - self.part.start)

    def budget(self, state: TrainState, limit: int) -> int:
        """Upper limit of the number of Gaussians: ``limit``, or as many as the steps that the time
        budget allows can train."""
        if self.estimator is None:
            return limit
        default = self.run_length(state) * len(self.part) / self.steps
        steps = self.estimator.steps(state.step, state.seconds, default)
        steps *= self.steps / len(self.part)
        return min(limit, round(GAUSSIANS_PER_STEP * steps))
