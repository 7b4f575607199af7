"""Ending on SIGTERM, which batch systems send some seconds before they kill a job, on SIGHUP, which
a terminal sends when it is closed, and on SIGINT (Ctrl-C)."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

EXIT_TERMINATED = 128 + signal.SIGTERM


class Terminated(BaseException):
    """The process was asked to end by SIGTERM or SIGHUP."""


_requested: type[BaseException] | None = None
_deferred = False


@contextmanager
def raising_when_terminated() -> Iterator[None]:
    """In the main thread, raise ``Terminated`` when SIGTERM or SIGHUP arrives, and
    ``KeyboardInterrupt`` when SIGINT does. SIGHUP and SIGINT stay ignored where they are, as under
    ``nohup`` or in the background of a shell script."""
    global _requested
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        numbers.append(signal.SIGINT)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        numbers.append(signal.SIGHUP)
    before = [signal.signal(number, _on_signal) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
        _requested = None


@contextmanager
def deferred() -> Iterator[None]:
    """Do not raise in the block, which must call ``check`` where it can end. A second Ctrl-C
    interrupts it at once."""
    global _deferred
    _deferred = True
    try:
        yield
    finally:
        _deferred = False


def requested() -> bool:
    """Whether one of the signals has arrived."""
    return _requested is not None


def check() -> None:
    """Raise the exception of the signal that has arrived, if any."""
    if _requested is not None:
        raise _requested


def _on_signal(number: int, frame: FrameType | None) -> None:
    global _requested
    again = _requested is not None
    _requested = KeyboardInterrupt if number == signal.SIGINT else Terminated
    if not _deferred or (again and number == signal.SIGINT):
        raise _requested
