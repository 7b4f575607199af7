"""Subsampling of point clouds by voxel grids: one point a voxel, the first in the file.

Grids are nested (sides are a power of two times the first side), so that the result does not
depend on how a file is divided into chunks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.io.clouds.values import Chunk, PointCloud

# The finest grid: parts of the extent of the first points, and bits of the largest coordinate.
_FINEST, _BITS = 2.0**-20, 40
# Coordinates beyond this have no finite squares in float32.
_MAX_COORDINATE = 1e18
# Odd 64-bit constants of a multiplicative hash (Steele et al. 2014, SplitMix64).
_MIX = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
_STEPS = 30


class VoxelSampler:
    """Keeps at most ``limit`` points of any number; memory is proportional to ``limit``."""

    def __init__(self, limit: int):
        self._limit = limit
        self._xyz = np.zeros((0, 3))
        self._colour = np.zeros((0, 3), np.float32)
        self._origin = np.zeros(3)
        self._voxel = 0.0  # Before the first points.
        self._full: float | None = None
        self._range = (np.inf, -np.inf)
        self._has_colour = True
        self._num_read = self._num_invalid = 0

    def add(self, chunk: Chunk) -> None:
        """Add consecutive points of one file."""
        with np.errstate(invalid="ignore"):
            valid = np.asarray((np.abs(chunk.xyz) < _MAX_COORDINATE).all(1))
        self._num_read += len(valid)
        self._num_invalid += len(valid) - int(valid.sum())
        if not valid.any():
            return
        xyz = chunk.xyz[valid]
        self._set_grid(xyz)
        self._xyz = np.concatenate([self._xyz, xyz])
        if chunk.colour is None:
            self._has_colour = False
        else:
            self._full = chunk.full
            low, high = float(chunk.colour.min()), float(chunk.colour.max())
            # NaN stays: such values are no colours.
            self._range = np.minimum(self._range[0], low), np.maximum(self._range[1], high)
        if self._has_colour and chunk.colour is not None:
            self._colour = np.concatenate([self._colour, chunk.colour[valid]])
        self._reduce()

    def result(self) -> PointCloud:
        """The points that were kept, in the order of the file."""
        rgb = self._rgb()
        coloured = np.full(len(self._xyz), rgb is not None)
        if rgb is None:
            rgb = np.zeros((len(self._xyz), 3), np.uint8)
        return PointCloud(self._xyz, rgb, coloured, self._num_read, self._num_invalid)

    def _set_grid(self, xyz: NDArray[np.float64]) -> None:
        if self._voxel == 0:
            self._origin = xyz[0]
            self._voxel = _power_of_two(float(np.ptp(xyz, axis=0).max()) * _FINEST)
        reach = float(np.abs(xyz - self._origin).max())
        self._voxel = max(self._voxel, _power_of_two(reach * 2.0**-_BITS))

    def _reduce(self) -> None:
        while True:
            kept = first_in_voxels(self._xyz - self._origin, self._voxel)
            self._xyz = self._xyz[kept]
            self._colour = self._colour[kept] if self._has_colour else self._colour
            if len(self._xyz) <= self._limit:
                return
            self._voxel *= 2

    def _rgb(self) -> NDArray[np.uint8] | None:
        """Colours as bytes; None if there are none, or values that cannot be colours."""
        low, high = self._range
        if not self._has_colour or not 0 <= low <= high <= 65535:
            return None
        full = self._full
        if full is None:
            full = 1.0 if high <= 1 else 255.0 if high <= 255 else 65535.0
        return np.rint(np.clip(self._colour / full, 0, 1) * 255).astype(np.uint8)


def first_in_voxels(xyz: NDArray[np.float64], voxel: float) -> NDArray[np.intp]:
    """Sorted indices of the first point in each voxel of side ``voxel``.

    Args:
        xyz: (N, 3) finite; fewer than 2^62 voxels from the origin.
    """
    cells = np.floor(xyz / voxel).astype(np.int64).view(np.uint64)
    # Two voxels in a million have the same hash with a probability of 1e-7.
    key = np.zeros(len(xyz), np.uint64)
    for axis, factor in enumerate(_MIX):
        key = (key ^ cells[:, axis]) * np.uint64(factor)
        key ^= key >> np.uint64(31)
    return np.sort(np.unique(key, return_index=True)[1])


def thinned(xyz: NDArray[np.float64], limit: int) -> NDArray[np.intp]:
    """Sorted indices of at most ``limit`` points, one a voxel of the smallest grid found by
    bisection that has so few voxels."""
    if len(xyz) <= limit:
        return np.arange(len(xyz))
    local = xyz - xyz[0]
    high = 2 * float(np.abs(local).max())
    if high == 0:
        return np.zeros(1, np.intp)
    low = high * 2.0**-_BITS
    best = first_in_voxels(local, high)[:limit]
    for _ in range(_STEPS):
        middle = float(np.sqrt(low * high))
        found = first_in_voxels(local, middle)
        if len(found) > limit:
            low = middle
        else:
            high = middle
            best = found if len(found) > len(best) else best
        if len(best) >= 0.99 * limit:
            break
    return best


def _power_of_two(value: float) -> float:
    """The largest power of two up to ``value``, at least 2^-900."""
    return 2.0 ** max(np.floor(np.log2(max(value, 1e-300))), -900)
