"""Progress of long work: a line on stderr and a small JSON file beside it.

In a stage the line stays in its place at the foot of the terminal while a person watches (see
``Console``), and the log gets one now and then. Elsewhere stderr does. No carriage returns where
there is no terminal, so that log files stay readable.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TextIO, TypeVar

T = TypeVar("T")

# A line every few seconds is enough for a person; a log of an hour stays under 1000 lines.
LINE_SECONDS = 5.0
FILE_SECONDS = 1.0
LIVE_SECONDS = 0.5
# Training slows down while the scene grows: the rate is that of the last seconds.
RATE_SECONDS = 20.0

_ERASE = "\r\x1b[K"

_file: Path | None = None


def write_progress_to(path: Path | None) -> None:
    """Let every later ``Progress`` also write its state to ``path`` (atomically)."""
    global _file
    _file = path


class Console:
    """Stands for stderr in a stage.

    What is printed goes to the terminal and to the log. Progress is one line that is replaced in
    its place while a person watches, and otherwise (no terminal, or CI) shown nowhere; the log has
    it in any case. The terminal may go away: the work does not end with it.

    Args:
        terminal: the true stderr.
        log: an open file; or None for no log.
        name: whose progress it is, said before it.
    """

    def __init__(self, terminal: TextIO, log: TextIO | None, name: str = ""):
        self._terminal: TextIO | None = terminal
        self._log = log
        self._name = name
        self._live = is_watched(terminal)
        self._shows_line = False
        self._last = 0.0

    def write(self, text: str) -> int:
        if self._log is not None:
            self._log.write(text)
        self.clear()
        self._to_terminal(text)
        return len(text)

    def progress(self, line: str, *, keep: bool) -> None:
        """Show ``line`` in place of the last one; ``keep`` it in the log."""
        if keep and self._log is not None:
            self._log.write(f"{line}\n")
            self._log.flush()
        now = time.monotonic()
        if self._live and now - self._last >= LIVE_SECONDS:
            self._last = now
            width = shutil.get_terminal_size().columns
            self._to_terminal(_ERASE + f"{self._name}{line}"[: width - 1])
            self._shows_line = True
            self.flush()

    def clear(self) -> None:
        """Take the line of progress away."""
        if self._shows_line:
            self._shows_line = False
            self._to_terminal(_ERASE)

    def flush(self) -> None:
        if self._log is not None:
            self._log.flush()
        if self._terminal is not None:
            try:
                self._terminal.flush()
            except OSError:
                self._terminal = None

    def isatty(self) -> bool:
        return self._terminal is not None and self._terminal.isatty()

    def _to_terminal(self, text: str) -> None:
        if self._terminal is not None:
            try:
                self._terminal.write(text)
            except OSError:
                self._terminal = None


def is_watched(stream: TextIO) -> bool:
    """Whether a person looks at ``stream``: a terminal that can move its cursor, not CI."""
    able = os.environ.get("TERM", "dumb") != "dumb"
    return stream.isatty() and able and not os.environ.get("CI")


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
        now = time.monotonic()
        self._marks = deque([(now, 0)])
        self._last_line = now
        self._last_file = 0.0

    def start_at(self, done: int) -> None:
        """Begin at ``done`` units (resumed work), so that the rate stays true."""
        self.done = done
        self._marks = deque([(time.monotonic(), done)])
        if done:
            print(f"{self.label}: going on from {done}/{self.total} {self.unit}", file=sys.stderr)

    def advance(self, count: int = 1, note: str = "") -> None:
        """Count ``count`` more units done; ``note`` is shown at the line's end."""
        self.done += count
        now = time.monotonic()
        if now - self._marks[-1][0] >= 1.0:
            self._marks.append((now, self.done))
            while len(self._marks) > 2 and now - self._marks[1][0] > RATE_SECONDS:
                self._marks.popleft()
        if now - self._last_file >= FILE_SECONDS and _file is not None:
            self._last_file = now
            self._write(note)
        due = now - self._last_line >= LINE_SECONDS or 0 < self.total == self.done
        if due:
            self._last_line = now
        if isinstance(sys.stderr, Console):
            sys.stderr.progress(self.line(note), keep=due)
        elif due:
            print(self.line(note), file=sys.stderr, flush=True)

    def rate(self) -> float:
        """Units a second of late."""
        since, done = self._marks[0]
        return (self.done - done) / max(time.monotonic() - since, 1e-9)

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
