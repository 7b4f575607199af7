"""Prefix sums, stable radix sorting, and sums over rows in a fixed order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.render.gpu.device import Buffer, blocks
from pipeline.render.gpu.workspace import Workspace

ROWS = 1024  # The rows of a workgroup in sum_rows.wgsl.
BLOCK = 2048  # kBlock in block.wgsl
DIGIT_BITS, DIGITS = 8, 256  # Of a pass of sort.wgsl.


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


def scan(
    space: Workspace, values: Buffer, rows: int, length: Buffer, stride: int, totals: Buffer
) -> None:
    """Replace the rows of a table of uint32 by their exclusive prefix sums.

    Args:
        length: One uint32, the length of an array. Each row has an element for each ``BLOCK`` of
            its elements.
        stride: The distance between the starts of two rows.
        totals: (rows,) uint32, becomes the sums of the rows.
    """
    size = space.gpu.uniform("I", stride)
    space.run("scan", rows, size=size, length=length, values=values, totals=totals)


def sort(
    space: Workspace, name: str, keys: Buffer, length: Buffer, *, capacity: int, bits: int
) -> Sorted:
    """Sort the indices of uint32 keys of at most ``bits`` bits by their keys. Keys of zero are left
    out; equal keys keep their order.

    Args:
        name: The name of the keys. The result's order and number are valid until the next sort of
            this name, its keys until the next sort.
        keys: They are overwritten.
        length: One uint32, the number of keys, which is at most ``capacity``.
    """
    groups, size = max(1, blocks(capacity, BLOCK)), 4 * capacity
    places, totals = space.get("places of digits", 4 * DIGITS * groups), space.get("digits", 1024)
    count = space.get(f"number of {name}", 4)
    other_keys = space.get("sort keys", size)
    order, other_order = space.get(f"order of {name}", size), space.get("sort order", size)
    passes = blocks(bits, DIGIT_BITS)
    if passes % 2 == 0:  # The last pass writes to the order of this name.
        order, other_order = other_order, order
    for each in range(passes):
        arguments = {
            "pass_": space.gpu.uniform("II", DIGIT_BITS * each, groups),
            "length": count if each else length,
            "keys": keys,
            "places": places,
        }
        space.run("sort.histogram", groups, **arguments)
        scan(space, places, DIGITS, arguments["length"], groups, totals)
        arguments |= {"totals": totals, "sorted_keys": other_keys, "sorted_order": order}
        arguments |= {"order": other_order} if each else {"count": count}
        space.run("sort.scatter", groups, **arguments)
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
