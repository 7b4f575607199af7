"""How fast a run by the clock goes: how many steps it will come to, and what they can train."""

from __future__ import annotations

from dataclasses import dataclass

#: Steps in a lap, whose mean time counts: the newest lap's so much, the rest is what it was.
LAP, NEWEST = 20, 0.3
#: What a full step takes of a step at 1 / factor of the size: less than its share of the pixels,
#: because every Gaussian costs something.
FULL_STEP = {1: 1.0, 2: 3.0, 4: 9.0}
#: As many Gaussians as a run can train. bonsai at 400x267 px in 190 to 205 CPU seconds, views kept
#: back: 31.73 dB, .947 with 150 000 in 9000 steps; 31.99, .950 with 210 000 in 7300; 31.79, .950
#: with 300 000 in 5600.
GAUSSIANS_A_STEP = 30


@dataclass
class Pace:
    """Of one process: after a kill the next learns it anew.

    Attributes:
        budget: seconds of the whole run.
        each: seconds that a step at full size takes, 0 while nobody knows.
        lap: the step, the seconds and the resolution's factor at which the newest lap began.
    """

    budget: float
    each: float = 0.0
    lap: tuple[int, float, int] | None = None

    def passes(self, step: int, seconds: float, factor: int) -> None:
        """So many steps and seconds of training are over; the next is at 1 / ``factor`` of the
        size."""
        if self.lap is None or self.lap[2] != factor:
            self.lap = step, seconds, factor
        elif step - self.lap[0] >= LAP:
            newest = (seconds - self.lap[1]) / (step - self.lap[0]) * FULL_STEP[factor]
            self.each += (newest - self.each) * (NEWEST if self.each else 1.0)
            self.lap = step, seconds, factor

    def steps(self, step: int, seconds: float, unknown: float) -> float:
        """Steps in all if it goes on as now, at full size; ``unknown`` before the first lap."""
        if not self.each:
            return unknown
        return step + max(0.0, self.budget - seconds) / self.each
