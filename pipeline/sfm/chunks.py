"""Division of a scene's photographs and pairs among jobs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")


def chunk(items: Sequence[T], number: int, jobs: int) -> Sequence[T]:
    """The consecutive items of one job; all chunks have nearly the same length.

    Args:
        number: The number of the job, from 1.
        jobs: The number of all jobs.
    """
    return items[(number - 1) * len(items) // jobs : number * len(items) // jobs]
