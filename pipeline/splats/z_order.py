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
        cells = means[rows].T.astype(np.float64, order="C")
        cells -= low[:, None]
        cells /= size[:, None]
        cells *= 2**_BITS - 1
        x, y, z = _spread(cells.astype(np.int64))
        code[rows] = x | y << 1 | z << 2

    for_ranges(len(means), threads, encode)
    return np.argsort(code, kind="stable")


def _bounds(means: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    # Each column is reduced alone: numpy takes much longer to reduce the first axis of (N, 3).
    columns = means.T
    return np.array([x.min() for x in columns]), np.array([x.max() for x in columns])


def _spread(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Insert two zero bits before each of the 21 bits of the values, in place."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values |= values << shift
        values &= mask
    return values
