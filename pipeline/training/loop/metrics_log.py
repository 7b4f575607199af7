"""The progress of training for programs that show it: ``train.metrics.jsonl``.

It contains times and memory, so that it is not part of the stage's result and lies beside the log.
"""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path

from pydantic import Field, ValidationError

from pipeline.runtime.json_file import JsonObject
from pipeline.runtime.memory import peak_memory_mb
from pipeline.training.loop.state import TrainState

NAME = "train.metrics.jsonl"
SECONDS = 1.0


class MetricsRecord(JsonObject):
    """The state of a training at one time."""

    time: float = Field(description="Unix time, seconds.")
    step: int = Field(ge=1, description="Number of optimiser steps done.")
    share: float = Field(description="Of the schedule, 0 to 1.")
    seconds: float = Field(description="Of training so far, in all processes of the run.")
    seconds_left: float = Field(description="Estimated.")
    loss: float | None = Field(description="Over the last hundredth of the run; null before.")
    psnr: float | None = Field(description="As `loss`, of training views, dB.")
    num_gaussians: int = Field(ge=0, description="Number of Gaussians.")
    sh_degree: int = Field(ge=0, le=3, description="Degree of the spherical harmonics in use.")
    resolution: float = Field(description="Of the images, over that of the views.")
    memory_mb: float = Field(description="Peak memory of the process, MiB.")


class MetricsLog:
    """A file with at most one line of JSON (``MetricsRecord``) a second, and one at the end. A
    resumed run keeps the lines up to its step.

    Args:
        path: The file; None: nothing is written. Errors of writing are ignored.
        step: The number of steps done.
    """

    def __init__(self, path: Path | None, step: int):
        self._path, self._last = path, 0.0
        if path is not None:
            with contextlib.suppress(OSError):
                path.parent.mkdir(parents=True, exist_ok=True)
                kept = [line for line in read_metrics_log(path) if line.step <= step]
                path.write_text("".join(map(_text, kept)))

    def write(self, state: TrainState, steps: int, factor: int, seconds_left: float) -> None:
        """Write a line if one is due; ``steps`` is the length of the schedule."""
        now = time.monotonic()
        if self._path is None or (now - self._last < SECONDS and state.clock < steps):
            return
        self._last = now
        last = state.curve[-1] if state.curve else None
        line = MetricsRecord(
            time=round(time.time(), 3),
            step=state.step,
            share=round(state.clock / steps, 6),
            seconds=round(state.seconds, 3),
            seconds_left=round(seconds_left, 1),
            loss=last and last.loss,
            psnr=last and last.psnr,
            num_gaussians=len(state.gaussians),
            sh_degree=state.gaussians.sh_degree,
            resolution=1 / factor,
            memory_mb=round(peak_memory_mb(), 1),
        )
        with contextlib.suppress(OSError), open(self._path, "a") as file:
            file.write(_text(line))


def read_metrics_log(path: Path) -> list[MetricsRecord]:
    """The lines of the file; incomplete lines are skipped, as are those of other versions."""
    lines = []
    for text in path.read_bytes().splitlines() if path.is_file() else []:
        with contextlib.suppress(ValidationError):
            lines.append(MetricsRecord.model_validate_json(text))
    return lines


def _text(line: MetricsRecord) -> str:
    return json.dumps(line.model_dump(mode="json")) + "\n"
