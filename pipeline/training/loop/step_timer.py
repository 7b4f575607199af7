"""The native library of a run and the measured time of its steps, for the log."""

from __future__ import annotations

from typing import Any

from pipeline.runtime.native import Built

#: Steps of this process before the measurement (cold caches), and steps of the measurement.
WARM_UP, MEASURED = 10, 40


class StepTimer:
    """Measures some early steps of one process, once.

    Args:
        steps: remaining steps of the run.
    """

    def __init__(self, built: Built, threads: int, steps: int):
        self.built, self.threads = built, threads
        self.done, self.start = 0, 0.0
        # Short runs have shorter measurements.
        self.first = min(WARM_UP, steps // 2)
        self.last = min(WARM_UP + MEASURED, steps)

    def after_step(self, seconds: float, factor: int) -> str | None:
        """The line for the log after the last measured step, else None.

        Args:
            seconds: of training so far.
            factor: by which the images were reduced.
        """
        self.done += 1
        if self.done == self.first:
            self.start = seconds
        if self.done != self.last or self.first == 0:
            return None
        each = 1e3 * (seconds - self.start) / (self.last - self.first)
        size = "full size" if factor == 1 else f"1/{factor} of their size"
        return (
            f"{self.built.target}, {self.built.compiler}, {self.threads} threads: "
            f"{each:.1f} ms a step, images at {size}"
        )


def build_record(built: Built) -> dict[str, str]:
    """The library as checkpoints record it."""
    return {"instruction_set": built.target, "compiler": built.compiler}


def other_build(values: dict[str, Any], built: Built) -> str | None:
    """A line for the log if a checkpoint was made with another library. It is used: results are
    equal to the last bit only with one library, but of the same quality with any."""
    before = values.get("built")
    if before is None or before == build_record(built):
        return None
    return (
        f"training continues with {built.target} ({built.compiler}) from a checkpoint made with "
        f"{before['instruction_set']} ({before['compiler']}): the last bits of the result are "
        "those of neither alone"
    )
