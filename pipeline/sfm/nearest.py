"""Exact nearest neighbour matching of descriptors: Python interface of csrc/nearest.cpp.

The library is compiled at first use, or beforehand by ``python -m pipeline.sfm.nearest`` (with
``--target`` for other processors).
"""

from __future__ import annotations

import ctypes
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.native import NativeLibrary, build_main
from pipeline.runtime.targets import Extension

LIBRARY = NativeLibrary(
    name="matcher",
    file="libmatcher.so",
    sources=Path(__file__).parent / "csrc",
    flags=("-std=c++17", "-O3", "-fPIC", "-Wall", "-Wno-psabi", "-Wno-unknown-warning-option"),
    # These instructions are dot products of bytes.
    extensions={
        "x86-64-v3": [Extension("avx_vnni", ("-mavxvnni",))],
        "x86-64-v4": [Extension("avx512_vnni", ("-mavx512vnni",))],
        "aarch64": [Extension("asimddp", ("-march=armv8.2-a+dotprod",))],
    },
)
SIZE = 128
# COLMAP's limit: descriptors (unit vectors times 512) more than 0.7 radians apart do not match.
MAX_DISTANCE = 2 * 512**2 * (1 - float(np.cos(0.7)))


@dataclass(frozen=True)
class Neighbours:
    """The two nearest descriptors of another photograph for each of F descriptors.

    Attributes:
        index: (F,) int32 index of the nearest (the lowest index of ties); -1 if there is none.
        first, second: (F,) int32 squared distances to the nearest and second nearest; 2^28 if there
            is none.
    """

    index: NDArray[np.int32]
    first: NDArray[np.int32]
    second: NDArray[np.int32]


def nearest(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> tuple[Neighbours, Neighbours]:
    """The two nearest descriptors of ``b`` for each of ``a``, and of ``a`` for each of ``b``.

    Integer arithmetic: the result is exact and the same on every machine. Releases the GIL.

    Args:
        a, b: (F, 128) and (G, 128) uint8.

    Raises:
        UserError: the library is not compiled and cannot be.
    """
    tables = [np.ascontiguousarray(table, np.uint8) for table in (a, b)]
    if any(table.ndim != 2 or table.shape[1] != SIZE for table in tables):
        raise ValueError(f"expected (F, {SIZE}) and (G, {SIZE}), found {a.shape} and {b.shape}")
    found = [Neighbours(*(np.empty(len(t), np.int32) for _ in range(3))) for t in tables]
    results = [array for n in found for array in (n.index, n.first, n.second)]
    arguments: list[object] = []
    for table in tables:
        arguments += [table.ctypes.data_as(ctypes.c_void_p), ctypes.c_int32(len(table))]
    arguments += [array.ctypes.data_as(ctypes.c_void_p) for array in results]
    _library().nearest(*arguments)
    return found[0], found[1]


def match_descriptors(
    a: NDArray[np.uint8], b: NDArray[np.uint8], max_ratio: float
) -> NDArray[np.uint32]:
    """Mutual nearest neighbours that pass Lowe's ratio test in both directions, as in COLMAP.

    Args:
        a, b: (F, 128), (G, 128) uint8, unit vectors times 512.
        max_ratio: The largest ratio of the distances to the nearest and the second nearest.

    Returns:
        (M, 2) indices into ``a`` and ``b``, sorted by the first.
    """
    of_a, of_b = nearest(a, b)
    if len(a) == 0 or len(b) == 0:
        return np.zeros((0, 2), np.uint32)
    index = of_a.index
    limit = max_ratio**2
    keep = of_b.index[index] == np.arange(len(a))
    keep &= of_a.first < limit * of_a.second
    keep &= of_b.first[index] < limit * of_b.second[index]
    keep &= of_a.first <= MAX_DISTANCE
    rows = np.flatnonzero(keep)
    return np.column_stack([rows, index[rows]]).astype(np.uint32)


@cache
def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(str(LIBRARY.build().path))
    library.nearest.restype = None
    return library


if __name__ == "__main__":
    sys.exit(build_main(lambda: LIBRARY))
