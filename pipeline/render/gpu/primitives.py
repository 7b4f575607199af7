"""Prefix sums, stable radix sorting, and sums over rows in a fixed order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.render.gpu.device import Buffer, blocks
from pipeline.render.gpu.workspace import Workspace

# The numbers of a workgroup in scan.wgsl and sort.wgsl, and its rows in sum_rows.wgsl.
BLOCK = 1024
DIGIT_BITS = 4  # The bits of a pass of sort.wgsl.


def scan(space: Workspace, values: Buffer, count: int, level: int = 0) -> None:
    """Replace ``count`` uint32 by their exclusive prefix sums."""
    groups = blocks(count, BLOCK)
    sums = space.get(f"scan sums {level}", 4 * groups)
    arguments = {"size": space.gpu.uniform("I", count), "values": values, "sums": sums}
    space.run("scan.blocks", groups, **arguments)
    if groups > 1:
        scan(space, sums, groups, level + 1)
        space.run("scan.add", groups, **arguments)


def sort(
    space: Workspace, keys: Buffer, values: Buffer, length: Buffer, *, capacity: int, bits: int
) -> tuple[Buffer, Buffer]:
    """Sort uint32 values by the lowest ``bits`` of their keys; equal keys keep their order.

    Args:
        length: One uint32, the number of keys, which is at most ``capacity``.

    Returns:
        The sorted keys and values: the buffers of the input or of the workspace. The other ones are
        overwritten.
    """
    groups = blocks(capacity, BLOCK)
    places = space.get("sort places", 4 * 16 * groups)
    others = space.get("sort keys", 4 * capacity), space.get("sort values", 4 * capacity)
    here = keys, values
    for shift in range(0, bits, DIGIT_BITS):
        arguments = {
            "pass_": space.gpu.uniform("II", shift, groups),
            "length": length,
            "keys": here[0],
            "values": here[1],
            "places": places,
            "sorted_keys": others[0],
            "sorted_values": others[1],
        }
        space.run("sort.histogram", groups, **arguments)
        scan(space, places, 16 * groups)
        space.run("sort.scatter", groups, **arguments)
        here, others = others, here
    return here


def sum_rows(space: Workspace, rows: Buffer, count: int, width: int) -> NDArray[np.float64]:
    """The sum of ``count`` rows of ``width`` float32; waits for it."""
    size = partial_sums(count, width)
    sums = space.get(f"sums of rows of {width}", 4 * size)
    sum_blocks(space, rows, count, width, sums)
    return add_partial_sums(space.gpu.read(sums, np.float32, size), width)


def partial_sums(count: int, width: int) -> int:
    """The number of float32 that ``sum_blocks`` writes."""
    return width * blocks(count, BLOCK)


def sum_blocks(
    space: Workspace, rows: Buffer, count: int, width: int, sums: Buffer, at: int = 0
) -> None:
    """Write the sums of blocks of ``BLOCK`` rows of ``width`` float32, from element ``at`` on."""
    size = space.gpu.uniform("III", count, width, at)
    space.run("sum_rows", blocks(count, BLOCK), size=size, values=rows, sums=sums)


def add_partial_sums(sums: NDArray[np.float32], width: int) -> NDArray[np.float64]:
    """The sum of all rows, from the sums of blocks."""
    return sums.reshape(-1, width).sum(0, dtype=np.float64)
