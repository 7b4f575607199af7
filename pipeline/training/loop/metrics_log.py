"""The progress of training for programs that show it: ``train.metrics.jsonl``.

It contains times and memory, so that it is not part of the stage's result and lies beside the log.
"""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path

from pipeline.runtime.memory import peak_memory_mb
from pipeline.training.loop.state import TrainState

NAME = "train.metrics.jsonl"
SECONDS = 1.0


class MetricsLog:
    """A file with at most one line of JSON a second, and one at the end.

    Fields: ``time`` (Unix, s), ``step``, ``share`` (of the schedule, 0 to 1), ``seconds`` (of
    training so far), ``seconds_left``, ``loss`` and ``psnr`` (dB; of training views, over the last
    hundredth of the run; null before), ``num_gaussians``, ``sh_degree``, ``resolution`` (1, 1/2 or
    1/4) and ``memory_mb`` (peak, MiB). A resumed run keeps the lines up to its step.

    Args:
        path: None writes nothing. Errors of writing are ignored.
        step: steps done.
    """

    def __init__(self, path: Path | None, step: int):
        self._path, self._last = path, 0.0
        if path is not None:
            with contextlib.suppress(OSError):
                path.parent.mkdir(parents=True, exist_ok=True)
                kept = [line for line in _lines(path) if 0 < _step(line) <= step]
                path.write_text("".join(f"{line}\n" for line in kept))

    def write(self, state: TrainState, steps: int, factor: int, seconds_left: float) -> None:
        """Write a line if one is due; ``steps`` is the length of the schedule."""
        now = time.monotonic()
        if self._path is None or (now - self._last < SECONDS and state.clock < steps):
            return
        self._last = now
        last = state.curve[-1] if state.curve else {}
        record = {
            "time": round(time.time(), 3),
            "step": state.step,
            "share": round(state.clock / steps, 6),
            "seconds": round(state.seconds, 3),
            "seconds_left": round(seconds_left, 1),
            "loss": last.get("loss"),
            "psnr": last.get("psnr"),
            "num_gaussians": len(state.gaussians),
            "sh_degree": state.gaussians.sh_degree,
            "resolution": 1 / factor,
            "memory_mb": round(peak_memory_mb(), 1),
        }
        with contextlib.suppress(OSError), open(self._path, "a") as file:
            file.write(json.dumps(record) + "\n")


def read_metrics_log(path: Path) -> list[dict[str, float | None]]:
    """The lines of the file; incomplete lines are skipped."""
    return [json.loads(line) for line in _lines(path) if _step(line) > 0]


def _lines(path: Path) -> list[str]:
    return path.read_text(errors="replace").splitlines() if path.is_file() else []


def _step(line: str) -> int:
    """The step of a line, 0 if it is incomplete."""
    try:
        return int(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return 0
