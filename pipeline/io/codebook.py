"""Quantisation of numbers to the 256 values of a codebook: one-dimensional k-means."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

SIZE = 256
# The quantiles that the density of the values is estimated from.
_QUANTILES = 4096
# Lloyd's algorithm needs about a hundred rounds until no value changes its cluster.
_MAX_ROUNDS = 1000


def make_codebook(values: NDArray[Any]) -> NDArray[np.float32]:
    """(256,) ascending values that represent ``values`` with a small mean squared error.

    Lloyd's algorithm on the sorted values. It starts with a density of codebook entries
    proportional to the cube root of the values' density, which is optimal for many entries (Panter
    and Dite 1951). If there are at most 256 different values, they are the codebook.
    """
    found = np.sort(np.asarray(values, np.float64), axis=None)
    different = np.unique(found)
    if len(different) <= SIZE:
        padding = different[-1:] if len(different) else np.zeros(1)
        padded = np.concatenate([different, np.repeat(padding, SIZE - len(different))])
        return padded.astype(np.float32)
    centres, cumulated = _initial(found), np.concatenate([[0.0], np.cumsum(found)])
    for _ in range(_MAX_ROUNDS):
        inner = np.searchsorted(found, (centres[1:] + centres[:-1]) / 2)
        cuts = np.concatenate([[0], inner, [len(found)]])
        counts = np.diff(cuts)
        means = np.diff(cumulated[cuts]) / np.maximum(counts, 1)
        updated = np.where(counts > 0, means, centres)
        if np.array_equal(updated, centres):
            break
        centres = updated
    return np.sort(centres).astype(np.float32)


def nearest_entries(codebook: NDArray[np.float32], values: NDArray[Any]) -> NDArray[np.uint8]:
    """The index of the nearest entry of an ascending codebook for each value."""
    borders = (codebook[1:].astype(np.float64) + codebook[:-1]) / 2
    return np.searchsorted(borders, values).astype(np.uint8)


def _initial(found: NDArray[np.float64]) -> NDArray[np.float64]:
    """256 values whose density is that of the sorted values ``found`` to the power 1/3."""
    cuts = found[np.linspace(0, len(found) - 1, _QUANTILES + 1).astype(np.int64)]
    # Between two quantiles of distance w, the density is proportional to 1 / w.
    cumulated = np.concatenate([[0.0], np.cumsum(np.diff(cuts) ** (2 / 3))])
    return np.interp((np.arange(SIZE) + 0.5) / SIZE * cumulated[-1], cumulated, cuts)
