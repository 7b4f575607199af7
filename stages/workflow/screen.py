"""Lines on the terminal, and below them a few lines that are updated in place."""

from __future__ import annotations

import contextlib
import shutil
import threading
from collections.abc import Sequence
from typing import TextIO

from pipeline.runtime.progress import is_interactive

_UP_AND_ERASE = "\x1b[{}A\r\x1b[J"


class Screen:
    """Writes to a stream from several threads.

    On an interactive terminal, ``show`` keeps lines at the bottom. Otherwise they are not written.
    A terminal that was closed is given up.

    Attributes:
        live: Whether the stream is an interactive terminal.
    """

    def __init__(self, stream: TextIO):
        self._stream = stream
        self._lock = threading.RLock()
        self._shown: list[str] = []
        self.live = is_interactive(stream)

    def print(self, text: str) -> None:
        """Write a text above the lines at the bottom."""
        with self._lock:
            bottom = self._shown
            self._replace([])
            self._write(f"{text}\n")
            self._replace(bottom)

    def show(self, lines: Sequence[str]) -> None:
        """Replace the lines at the bottom. They are cut to the terminal's width, and their number
        to its height."""
        if not self.live:
            return
        size = shutil.get_terminal_size()
        kept = [line[: size.columns - 1] for line in lines[: max(1, size.lines - 2)]]
        with self._lock:
            if kept != self._shown:
                self._replace(kept)

    def _replace(self, lines: list[str]) -> None:
        if self._shown:
            self._write(_UP_AND_ERASE.format(len(self._shown)))
        self._shown = lines
        self._write("".join(f"{line}\n" for line in lines))

    def _write(self, text: str) -> None:
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(text)
            self._stream.flush()
