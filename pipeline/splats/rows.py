"""Work on rows of tensors and arrays, in ranges on several threads. torch itself runs on one thread
while it trains, since its sums depend on the number of threads."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from pipeline.runtime.memory import huge_pages

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


def take_rows(
    tensors: Mapping[str, Tensor], rows: Tensor, threads: int, zeroed: Tensor | None = None
) -> dict[str, Tensor]:
    """``tensor[rows]`` of each tensor, contiguous, of int64 indices (M,); 0 in the rows of the
    result that ``zeroed`` (M,) bool contains."""
    import torch

    taken = new_rows(tensors, len(rows))

    def take(part: slice) -> None:
        empty = None if zeroed is None else torch.nonzero(zeroed[part])[:, 0]
        for name, tensor in tensors.items():
            to = taken[name][part]
            torch.index_select(tensor, 0, rows[part], out=to)
            if empty is not None:
                to.index_fill_(0, empty, 0.0)

    for_ranges(len(rows), threads, take)
    return taken


def new_rows(tensors: Mapping[str, Tensor], count: int) -> dict[str, Tensor]:
    """Tensors of ``count`` rows like those of ``tensors``, not initialised."""
    return {name: _new_rows(tensor, count) for name, tensor in tensors.items()}


def _new_rows(tensor: Tensor, count: int) -> Tensor:
    """(count, ...) values like a row of ``tensor``, not initialised."""
    import torch

    shape = (count, *tensor.shape[1:])
    pages = huge_pages(math.prod(shape) * tensor.element_size())
    if pages is None:
        return tensor.new_empty(shape)
    return torch.frombuffer(pages, dtype=tensor.dtype).view(shape)
