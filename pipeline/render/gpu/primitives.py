"""Stable radix sorting, and sums over rows in a fixed order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.render.gpu.device import Buffer, blocks
from pipeline.render.gpu.workspace import Workspace

ROWS = 1024  # The rows of a workgroup in sum_rows.wgsl.
BLOCK = 2048  # kBlock in block.wgsl
DIGIT_BITS, DIGITS = 8, 256  # Of a pass of sort.wgsl.
SCANNED = 8  # kScanned in sort.wgsl


@dataclass(frozen=True)
class Sorted:
    """Sorted keys.

    Attributes:
        keys: (count,) uint32, the keys in ascending order.
        order: (count,) uint32, the index of each of them before sorting.
        count: One uint32, the number of keys that are not zero.
    """

    keys: Buffer
    order: Buffer
    count: Buffer


def sort(
    space: Workspace,
    name: str,
    keys: Buffer,
    length: Buffer,
    *,
    capacity: int,
    bits: int,
    used: int | None = None,
) -> Sorted:
    """Sort the indices of uint32 keys of at most ``bits`` bits by their keys. Keys of zero are left
    out; equal keys keep their order.

    Args:
        name: The name of the keys. The result's order and number are valid until the next sort of
            this name, its keys until the next sort.
        keys: They are overwritten.
        length: One uint32, the number of keys, which is at most ``capacity``.
        used: The number of keys for the counts; None: ``capacity``.
    """
    groups, size = max(1, blocks(capacity, BLOCK)), 4 * capacity
    used = capacity if used is None else used
    places = space.get("places of digits", 4 * DIGITS * groups, 4 * DIGITS * blocks(used, BLOCK))
    totals = space.get("numbers of digits", 4 * DIGITS)
    count = space.get(f"number of {name}", 4)
    other_keys = space.get("sort keys", size, 4 * used)
    order, other_order = (
        space.get(each, size, 4 * used) for each in (f"order of {name}", "sort order")
    )
    passes = blocks(bits, DIGIT_BITS)
    if passes % 2 == 0:  # The last pass writes to the order of this name.
        order, other_order = other_order, order
    for each in range(passes):
        pass_, number = space.gpu.uniform("I", DIGIT_BITS * each), count if each else length
        both = {"pass_": pass_, "length": number, "keys": keys, "places": places}
        space.run("sort.histogram", groups, **both)
        space.run("sort.scan", DIGITS // SCANNED, length=number, places=places, totals=totals)
        more = {"order": other_order} if each else {"count": count}
        space.run(
            "sort.scatter", groups, **both, **more, totals=totals, sorted_keys=other_keys,
            sorted_order=order,
        )  # fmt: skip
        keys, other_keys = other_keys, keys
        order, other_order = other_order, order
    return Sorted(keys, other_order, count)


def sum_rows(space: Workspace, rows: Buffer, count: int, width: int) -> NDArray[np.float64]:
    """The sum of ``count`` rows of ``width`` float32; waits for it."""
    size = partial_sums(count, width)
    sums = space.get(f"sums of rows of {width}", 4 * size)
    sum_blocks(space, rows, count, width, sums)
    return add_partial_sums(space.gpu.read(sums, np.float32, size), width)


def partial_sums(count: int, width: int) -> int:
    """The number of float32 that ``sum_blocks`` writes."""
    return width * blocks(count, ROWS)


def sum_blocks(
    space: Workspace, rows: Buffer, count: int, width: int, sums: Buffer, at: int = 0
) -> None:
    """Write the sums of blocks of ``ROWS`` rows of ``width`` float32, from element ``at`` on."""
    size = space.gpu.uniform("III", count, width, at)
    space.run("sum_rows", blocks(count, ROWS), size=size, values=rows, sums=sums)


def add_partial_sums(sums: NDArray[np.float32], width: int) -> NDArray[np.float64]:
    """The sum of all rows, from the sums of blocks."""
    return sums.reshape(-1, width).sum(0, dtype=np.float64)
