"""Morton (Z-order) sorting of positions. Importing this module does not import torch."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.splats.rows import for_ranges

_BITS = 21  # Three coordinates fit into 63 bits.


def z_order(means: NDArray[Any], threads: int = 1) -> NDArray[np.intp]:
    """(N,) indices that sort ``means`` (N, 3) along a Z-order curve through their bounding box,
    which has 2^21 cells per side; the sort is stable."""
    if not len(means):
        return np.zeros(0, np.intp)
    bounds: list[NDArray[Any]] = []
    for_ranges(len(means), threads, lambda rows: bounds.extend(_bounds(means[rows])))
    low, high = (np.asarray(bound, np.float64) for bound in _bounds(np.array(bounds)))
    size = np.maximum(high - low, 1e-30)
    code = np.empty(len(means), np.int64)

    def encode(rows: slice) -> None:
        x, y, z = ((means[rows] - low) / size * (2**_BITS - 1)).astype(np.int64).T
        code[rows] = _spread(x) | _spread(y) << 1 | _spread(z) << 2

    for_ranges(len(means), threads, encode)
    return np.argsort(code, kind="stable")


def _bounds(means: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    return means.min(0), means.max(0)


def _spread(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Insert two zero bits before each of the 21 bits of (N,) values."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | values << shift) & mask
    return values
