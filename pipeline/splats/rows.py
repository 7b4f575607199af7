"""Work on rows of tensors and arrays, in ranges on several threads. torch itself runs on one thread
while it trains, since its sums depend on the number of threads."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

# Rows of a range: a whole number of vectors, so that torch computes the same bits as in one piece.
RANGE_ROWS = 16384


def for_ranges(count: int, threads: int, work: Callable[[slice], None]) -> None:
    """Call ``work`` for ranges of ``count`` rows. The ranges do not depend on the number of
    threads. An error in one of them is raised when all are done."""
    ranges = [slice(k, min(k + RANGE_ROWS, count)) for k in range(0, count, RANGE_ROWS)]
    if threads < 2 or len(ranges) < 2:
        for rows in ranges:
            work(rows)
        return
    with ThreadPoolExecutor(min(threads, len(ranges))) as pool:
        for _ in pool.map(work, ranges):
            pass


def take_rows(tensors: Mapping[str, Tensor], rows: Tensor, threads: int) -> dict[str, Tensor]:
    """``tensor[rows]`` of each tensor, contiguous, of int64 indices (M,)."""
    import torch

    taken = {k: v.new_empty(len(rows), *v.shape[1:]) for k, v in tensors.items()}

    def take(part: slice) -> None:
        for name, tensor in tensors.items():
            torch.index_select(tensor, 0, rows[part], out=taken[name][part])

    for_ranges(len(rows), threads, take)
    return taken
