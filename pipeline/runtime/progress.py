"""Progress of long work: a line on stderr and a small JSON file.

In a stage (see ``Console``) the line is updated in place on an interactive terminal, and appended
to the log every few seconds. Without a terminal, lines are appended to stderr. In a run of
Snakemake, which shows the progress of all its jobs, a stage writes to its log and the JSON file
alone.
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
from contextvars import ContextVar
from pathlib import Path
from typing import TextIO, TypeVar

from pydantic import Field

from pipeline.runtime.json_file import JsonObject
from pipeline.runtime.text import duration

T = TypeVar("T")

# Intervals between lines of a log (an hour's log has less than 1000 lines), updates of the JSON
# file, and updates of the terminal.
LINE_SECONDS = 5.0
FILE_SECONDS = 1.0
LIVE_SECONDS = 0.5
# The rate is averaged over this time, because training slows down as the number of Gaussians grows.
RATE_SECONDS = 20.0


class ProgressState(JsonObject):
    """The content of the JSON file."""

    label: str = Field(description="What is being done.")
    done: int = Field(ge=0, description="Finished units.")
    total: int = Field(ge=0, description="Units in all.")
    unit: str = Field(description="Name of the units.")
    rate: float = Field(description="Units per second, averaged over the last seconds.")
    seconds_left: float = Field(description="Estimated.")
    note: str = Field(description="State of the work, a few words; may be empty.")


_ERASE = "\r\x1b[K"

_file: Path | None = None
_latest: Progress | None = None


def write_progress_to(path: Path | None) -> None:
    """Set the file that all ``Progress`` objects write their state to, or None."""
    global _file, _latest
    _file = path
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        _latest = None


def progress_text(state: ProgressState) -> str:
    """A line on the state of some work: its position, the time left, its note."""
    at = _position(state.unit, state.done, state.total)
    # The first units and the last second say little about the rest.
    is_known = state.done >= max(2, 0.05 * state.total) and state.seconds_left >= 1
    left = f", {duration(round(state.seconds_left))} left" if is_known else ""
    return f"{state.label}: {at}{left}{f', {state.note}' if state.note else ''}"


def progress_file(scene_folder: Path, job: str) -> Path:
    """The file with the progress of a job, whose stage has this folder in ``scene_folder``."""
    return scene_folder / ".scratch" / "progress" / f"{job}.json"


def position() -> str:
    """The position of the last work of this process, such as "step 702 of 1500"; may be empty."""
    return "" if _latest is None else _position(_latest.unit, _latest.done, _latest.total)


def _position(unit: str, done: int, total: int) -> str:
    return f"{unit.removesuffix('s')} {done} of {total}"


class Console:
    """Replacement of stderr in a stage, which writes to the terminal and to a log.

    On an interactive terminal the progress is a single line that is updated in place; otherwise
    (no terminal, or CI) it is only written to the log. A terminal that was closed and a log that
    cannot be written, as on a full disk, are given up: the stage goes on without them.

    Args:
        terminal: The original stderr.
        log: An open file, or None.
        name: The prefix of progress lines on the terminal.
        only_log: Whether to write to the terminal only what the log cannot take.
    """

    def __init__(
        self, terminal: TextIO, log: TextIO | None, name: str = "", *, only_log: bool = False
    ):
        self._terminal: TextIO | None = None if only_log else terminal
        self._without_log = terminal if only_log else None
        self._log = log
        self._name = name
        self._live = not only_log and is_interactive(terminal)
        self._shows_line = False
        self._last = 0.0

    def write(self, text: str) -> int:
        self._to_log(text)
        self.clear()
        self._to_terminal(text)
        return len(text)

    def progress(self, line: str, *, keep: bool) -> None:
        """Show ``line`` instead of the last one; with ``keep``, append it to the log."""
        if keep:
            self._to_log(f"{line}\n")
        now = time.monotonic()
        if self._live and now - self._last >= LIVE_SECONDS:
            self._last = now
            width = shutil.get_terminal_size().columns
            self._to_terminal(_ERASE + f"{self._name}{line}"[: width - 1])
            self._shows_line = True
            self.flush()

    def clear(self) -> None:
        """Erase the progress line."""
        if self._shows_line:
            self._shows_line = False
            self._to_terminal(_ERASE)

    def flush(self) -> None:
        if self._terminal is not None:
            try:
                self._terminal.flush()
            except OSError:
                self._terminal = None

    def isatty(self) -> bool:
        return self._terminal is not None and self._terminal.isatty()

    def _to_log(self, text: str) -> None:
        if self._log is not None:
            try:
                self._log.write(text)
                self._log.flush()
            except OSError:
                self._log = None
                self._terminal = self._terminal or self._without_log

    def _to_terminal(self, text: str) -> None:
        if self._terminal is not None:
            try:
                self._terminal.write(text)
            except OSError:
                self._terminal = None


def is_interactive(stream: TextIO) -> bool:
    """Whether ``stream`` is a terminal with cursor control, and not one of CI."""
    has_cursor = os.environ.get("TERM", "dumb") != "dumb"
    return stream.isatty() and has_cursor and not os.environ.get("CI")


class Progress:
    """Counts units of work and shows the rate and the remaining time.

    Args:
        label: The work, such as "extracting features".
        total: The number of units.
        unit: The name of the units, such as "images".
    """

    def __init__(self, label: str, total: int, unit: str = "it"):
        self.label, self.total, self.unit = label, total, unit
        self.done = 0
        now = time.monotonic()
        self._samples = deque([(now, 0)])
        self._last_line = now
        self._last_file = 0.0
        global _latest
        _latest = self

    def start_at(self, done: int) -> None:
        """Resume at ``done`` units, which do not count for the rate."""
        self.done = done
        self._samples = deque([(time.monotonic(), done)])
        if done:
            print(f"{self.label}: resuming at {done}/{self.total} {self.unit}", file=sys.stderr)

    def advance(self, count: int = 1, note: str = "") -> None:
        """Add ``count`` finished units; ``note`` is shown at the end of the line."""
        self.done += count
        now = time.monotonic()
        if now - self._samples[-1][0] >= 1.0:
            self._samples.append((now, self.done))
            while len(self._samples) > 2 and now - self._samples[1][0] > RATE_SECONDS:
                self._samples.popleft()
        if now - self._last_file >= FILE_SECONDS and _file is not None:
            self._last_file = now
            self._write(note)
        due = now - self._last_line >= LINE_SECONDS or 0 < self.total == self.done
        if due:
            self._last_line = now
        if isinstance(sys.stderr, Console):
            sys.stderr.progress(self.line(note), keep=due)
        elif due and _shown.get():
            print(self.line(note), file=sys.stderr, flush=True)

    def rate(self) -> float:
        """Units per second, averaged over ``RATE_SECONDS``."""
        since, done = self._samples[0]
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
        state = ProgressState(
            label=self.label,
            done=self.done,
            total=self.total,
            unit=self.unit,
            rate=self.rate(),
            seconds_left=self.seconds_left(),
            note=note,
        )
        # Progress is optional: a full disk or another run's file is no error.
        temporary = _file.with_suffix(f".{os.getpid()}.tmp")
        with contextlib.suppress(OSError):
            try:
                temporary.write_text(json.dumps(state.model_dump(mode="json")))
                os.replace(temporary, _file)
            finally:
                temporary.unlink(missing_ok=True)


def track(items: Iterable[T], label: str, total: int, unit: str = "it") -> Iterator[T]:
    """Yield ``items`` while showing progress."""
    progress = Progress(label, total, unit)
    for item in items:
        yield item
        progress.advance()


_shown = ContextVar("_shown", default=True)


@contextlib.contextmanager
def progress_shown(shown: bool) -> Iterator[None]:
    """Whether the progress of the work in the block is shown on stderr."""
    token = _shown.set(shown)
    try:
        yield
    finally:
        _shown.reset(token)
