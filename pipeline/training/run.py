"""The settings of a training: all of its arguments besides the inputs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.config.settled import TrainOptions
from pipeline.training.density.timeline import schedule_length


@dataclass(frozen=True)
class Part:
    """A part of a run's schedule.

    Attributes:
        begin, end: The shares of the schedule where the part begins and ends.
    """

    begin: float = 0.0
    end: float = 1.0

    def of(self, steps: int) -> range:
        """The steps of a schedule of so many steps, counted from 0."""
        return range(round(self.begin * steps), max(1, round(self.end * steps)))


WHOLE_RUN = Part()


@dataclass(frozen=True)
class TrainingRun:
    """How a scene or a block is trained. Only ``options``, ``seed`` and ``part`` change the result.

    Attributes:
        options: The settled options.
        checkpoint_dir: The folder of the checkpoints, from the newest of which a killed training is
            resumed. The caller deletes it when the result is stored.
        logs: The folder of the metrics log (``training.loop.metrics_log``); None: no such log.
        seed: The seed of all random numbers.
        threads: The number of threads that the native operators use. torch itself runs on one, so
            that sums do not change.
        memory_mb: The memory limit of training: images that do not fit beside the Gaussians are
            read from a temporary file. It is never above three quarters of the memory of the
            machine or container, which is the limit for None.
        part: The part of the schedule that is trained.
    """

    options: TrainOptions
    checkpoint_dir: Path
    logs: Path | None = None
    seed: int = 0
    threads: int = 1
    memory_mb: int | None = None
    part: Part = WHOLE_RUN

    @property
    def steps(self) -> int:
        """The length of the whole schedule."""
        return schedule_length(self.options)

    @property
    def span(self) -> range:
        """The steps of the part, counted from 0."""
        return self.part.of(self.steps)

    @property
    def is_part(self) -> bool:
        """Whether the scene is trained in blocks, which is where memory is short."""
        return self.part != WHOLE_RUN
