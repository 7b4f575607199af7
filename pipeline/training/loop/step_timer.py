"""What training runs on, and the measured time of its steps: for the log, no part of a result.

A build is what ``Backend.facts`` says: the instruction set and the compiler, by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Steps of this process before the measurement (first pages of memory, cold caches), and in it.
WARM_UP, MEASURED = 10, 40


class StepTimer:
    """Measures some early steps of one process, once.

    Args:
        steps: that are left to do.
    """

    def __init__(self, build: Mapping[str, str], threads: int, steps: int):
        self.build, self.threads = build, threads
        self.done, self.start = 0, 0.0
        # A short run is measured as well as it can be.
        self.first = min(WARM_UP, steps // 2)
        self.last = min(WARM_UP + MEASURED, steps)

    def passes(self, seconds: float, factor: int) -> str | None:
        """A step is over. Returns the line for the log after the last one that is measured.

        Args:
            seconds: of training so far.
            factor: that the pictures were reduced by.
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


def other_build(values: dict[str, Any], build: Mapping[str, str]) -> str | None:
    """A line for the log where a checkpoint was made by another build. It is used all the same:
    the bits are promised for one build alone, the quality is the same with any."""
    before = values.get("built")
    facts = "{instruction_set} ({compiler})"
    if before is None or before == build:
        return None
    return (
        f"training continues with {facts.format(**build)} from a checkpoint made with "
        f"{facts.format(**before)}: the last bits of the result are those of neither alone"
    )
