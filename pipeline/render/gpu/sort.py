"""Prefix sums and stable radix sorting."""

from __future__ import annotations

from pipeline.render.gpu.device import Buffer, Gpu, blocks
from pipeline.render.gpu.workspace import Workspace

BLOCK = 1024  # numbers per workgroup in scan.wgsl and sort.wgsl
DIGIT_BITS = 4  # of a pass of sort.wgsl


def scan(gpu: Gpu, space: Workspace, values: Buffer, count: int, level: int = 0) -> None:
    """Replace ``count`` uint32 by their exclusive prefix sums."""
    groups = blocks(count, BLOCK)
    sums = space.get(f"scan sums {level}", 4 * groups)
    arguments = {"size": gpu.uniform("I", count), "values": values, "sums": sums}
    space.run("scan.blocks", groups, **arguments)
    if groups > 1:
        scan(gpu, space, sums, groups, level + 1)
        space.run("scan.add", groups, **arguments)


def sort(
    gpu: Gpu,
    space: Workspace,
    keys: Buffer,
    values: Buffer,
    length: Buffer,
    *,
    capacity: int,
    bits: int,
) -> tuple[Buffer, Buffer]:
    """Sort uint32 values by the lowest ``bits`` of their keys; equal keys keep their order.

    Args:
        length: one uint32, the number of keys, at most ``capacity``.

    Returns:
        The sorted keys and values: the buffers of the input or of the workspace, with the other
        ones overwritten.
    """
    groups = blocks(capacity, BLOCK)
    places = space.get("sort places", 4 * 16 * groups)
    others = space.get("sort keys", 4 * capacity), space.get("sort values", 4 * capacity)
    here = keys, values
    for shift in range(0, bits, DIGIT_BITS):
        arguments = {
            "pass_": gpu.uniform("II", shift, groups),
            "length": length,
            "keys": here[0],
            "values": here[1],
            "places": places,
            "sorted_keys": others[0],
            "sorted_values": others[1],
        }
        space.run("sort.histogram", groups, **arguments)
        scan(gpu, space, places, 16 * groups)
        space.run("sort.scatter", groups, **arguments)
        here, others = others, here
    return here
