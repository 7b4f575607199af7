"""Progress of long work: one line now and then on stderr, and a small JSON file beside it.

No carriage returns, so that log files stay readable.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

# A line every few seconds is enough for a person; a log of an hour stays under 1000 lines.
LINE_SECONDS = 5.0
FILE_SECONDS = 1.0

_file: Path | None = None


def write_progress_to(path: Path | None) -> None:
    """Let every later ``Progress`` also write its state to ``path`` (atomically)."""
    global _file
    _file = path


class Progress:
    """Counts work and says how fast it goes and how long it still takes.

    Args:
        label: what is being done ("extracting features").
        total: number of units.
        unit: the name of one unit, for the rate ("images").
    """

    def __init__(self, label: str, total: int, unit: str = "it"):
        self.label, self.total, self.unit = label, total, unit
        self.done = 0
        self._start = time.monotonic()
        self._start_done = 0
        self._last_line = self._start
        self._last_file = 0.0

    def start_at(self, done: int) -> None:
        """Begin at ``done`` units (resumed work), so that the rate stays true."""
        self.done = self._start_done = done
        if done:
            print(f"{self.label}: going on from {done}/{self.total} {self.unit}", file=sys.stderr)

    def advance(self, count: int = 1, note: str = "") -> None:
        """Count ``count`` more units done; ``note`` is shown at the line's end."""
        self.done += count
        now = time.monotonic()
        if now - self._last_file >= FILE_SECONDS and _file is not None:
            self._last_file = now
            self._write(note)
        if now - self._last_line >= LINE_SECONDS or (self.done == self.total and self.total > 0):
            self._last_line = now
            print(self.line(note), file=sys.stderr, flush=True)

    def rate(self) -> float:
        """Units a second since the start."""
        return (self.done - self._start_done) / max(time.monotonic() - self._start, 1e-9)

    def seconds_left(self) -> float:
        """Estimated seconds to the end."""
        return (self.total - self.done) / max(self.rate(), 1e-9)

    def line(self, note: str = "") -> str:
        rate, left = self.rate(), self.seconds_left()
        clock = f"{int(left) // 60}:{int(left) % 60:02d}"
        tail = f", {note}" if note else ""
        return (
            f"{self.label}: {self.done}/{self.total} {self.unit}, "
            f"{rate:.1f} {self.unit}/s, {clock} left{tail}"
        )

    def _write(self, note: str) -> None:
        assert _file is not None
        state = {
            "label": self.label,
            "done": self.done,
            "total": self.total,
            "unit": self.unit,
            "rate": self.rate(),
            "seconds_left": self.seconds_left(),
            "note": note,
        }
        # Only a nicety: neither a full disk nor another run's file may end the work.
        temporary = _file.with_suffix(f".{os.getpid()}.tmp")
        with contextlib.suppress(OSError):
            temporary.write_text(json.dumps(state))
            os.replace(temporary, _file)


def track(items: Iterable[T], label: str, total: int, unit: str = "it") -> Iterator[T]:
    """Yield ``items`` while showing progress."""
    progress = Progress(label, total, unit)
    for item in items:
        yield item
        progress.advance()
