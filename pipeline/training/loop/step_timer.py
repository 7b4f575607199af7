"""The build of the rasterizer in a run and the measured time of its steps, for the log.

A build is what ``Backend.facts`` returns: the instruction set and the compiler, by name.
"""

from __future__ import annotations

from collections.abc import Mapping

#: Steps of this process before the measurement (cold caches), and steps of the measurement.
WARM_UP, MEASURED = 10, 40


class StepTimer:
    """Measures some early steps of one process, once.

    Args:
        steps: The remaining steps of the run.
    """

    def __init__(self, build: Mapping[str, str], threads: int, steps: int):
        self.build, self.threads = build, threads
        self.done, self.start = 0, 0.0
        # Short runs have shorter measurements.
        self.first = min(WARM_UP, steps // 2)
        self.last = min(WARM_UP + MEASURED, steps)

    def after_step(self, seconds: float, factor: int) -> str | None:
        """The line for the log after the last measured step, else None.

        Args:
            seconds: The seconds of training so far.
            factor: The factor by which the images were reduced.
        """
        self.done += 1
        if self.done == self.first:
            self.start = seconds
        if self.done != self.last or self.first == 0:
            return None
        each = 1e3 * (seconds - self.start) / (self.last - self.first)
        size = "full size" if factor == 1 else f"1/{factor} of their size"
        return (
            f"{', '.join(self.build.values())}, {self.threads} threads: "
            f"{each:.1f} ms a step, images at {size}"
        )
