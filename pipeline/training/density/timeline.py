"""When a density strategy acts, in steps of the schedule.

Steps are counted from 1: "after step t". Intervals in the options hold for runs of
``NOMINAL_STEPS`` and more; shorter runs shrink them by ``steps / NOMINAL_STEPS``, so that they pass
through the same phases.
"""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.config.experiments import DensityExperiments
from pipeline.config.settled import TrainOptions

NOMINAL_STEPS = 7000
# The mean of a gradient over fewer steps than this is too noisy.
MIN_INTERVAL = 10
# If densification has ended, pruned Gaussians are not replaced in the rest of the run.
PRUNE_UNTIL = 0.9


def schedule_length(options: TrainOptions) -> int:
    """The number of steps of the schedule. A run with a time budget passes through a schedule of
    ``NOMINAL_STEPS`` steps."""
    return options.steps if options.budget_minutes is None else NOMINAL_STEPS


def shrunk(interval: int, steps: int) -> int:
    """``interval`` in a run of so many steps."""
    return round(interval * min(1.0, steps / NOMINAL_STEPS))


@dataclass(frozen=True)
class Timeline:
    """The steps after which a strategy changes the set of Gaussians.

    Attributes:
        start, stop: The first and last step of densification.
        interval: The number of steps between densifications, and afterwards between prunings.
        prune_stop: The last step of pruning.
    """

    start: int
    stop: int
    interval: int
    prune_stop: float

    @staticmethod
    def of(options: DensityExperiments, steps: int) -> Timeline:
        """The timeline in a run of so many steps."""
        return Timeline(
            start=shrunk(options.start_step, steps),
            stop=round(options.stop_share * steps),
            interval=shrunk_interval(options.interval, steps),
            prune_stop=PRUNE_UNTIL * steps,
        )

    def densifies_after(self, step: int) -> bool:
        return self.start <= step <= self.stop and step % self.interval == 0

    def prunes_after(self, step: int) -> bool:
        """Return True if a step prunes without densifying: useless Gaussians cost time."""
        return self.stop < step <= self.prune_stop and step % self.interval == 0


def shrunk_interval(interval: int, steps: int) -> int:
    """Steps between densifications in a run of so many steps."""
    return max(min(interval, MIN_INTERVAL), shrunk(interval, steps))
