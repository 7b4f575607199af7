"""Ending on SIGTERM, which batch systems send some seconds before they kill a job."""

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
def raising_on_sigterm() -> Iterator[None]:
    """In the main thread, raise ``Terminated`` when SIGTERM arrives."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _on_sigterm)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
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
    """Whether SIGTERM has arrived."""
    return _requested.is_set()


def _on_sigterm(number: int, frame: FrameType | None) -> None:
    _requested.set()
    if not _deferred:
        raise Terminated
