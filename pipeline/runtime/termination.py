"""Ending on SIGTERM, which batch systems send some seconds before they kill a job, and on SIGHUP,
which a terminal sends when it is closed."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

EXIT_TERMINATED = 128 + signal.SIGTERM


class Terminated(BaseException):
    """The process was asked to end."""


_requested = threading.Event()
_deferred = False


@contextmanager
def raising_when_terminated() -> Iterator[None]:
    """In the main thread, raise ``Terminated`` when SIGTERM or SIGHUP arrives. SIGHUP stays ignored
    where it is, as under ``nohup``."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        numbers.append(signal.SIGHUP)
    before = [signal.signal(number, _on_signal) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
        _requested.clear()


@contextmanager
def deferred() -> Iterator[None]:
    """Do not raise in the block, which must look at ``requested`` where it can end."""
    global _deferred
    _deferred = True
    try:
        yield
    finally:
        _deferred = False


def requested() -> bool:
    """Whether one of the signals has arrived."""
    return _requested.is_set()


def _on_signal(number: int, frame: FrameType | None) -> None:
    _requested.set()
    if not _deferred:
        raise Terminated
