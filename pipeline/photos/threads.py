"""Work on many photographs, each on a thread of its own, in which OpenCV starts no others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import cv2

from pipeline.runtime.progress import Progress

T = TypeVar("T")
R = TypeVar("R")


@contextmanager
def one_thread_of_opencv() -> Iterator[None]:
    """Let OpenCV start no threads, so that its results do not depend on their number."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def for_each(
    work: Callable[[T], R], items: Sequence[T], threads: int, label: str, unit: str
) -> list[R]:
    """The results of ``work`` for all items, in order, with progress. Stops after an error."""
    progress = Progress(label, len(items), unit)
    results = []
    with one_thread_of_opencv(), ThreadPoolExecutor(max(threads, 1)) as pool:
        try:
            for result in pool.map(work, items):
                results.append(result)
                progress.advance()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return results
