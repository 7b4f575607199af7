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
# Range of relative voxel sides, powers of two.
_LEVELS = 10


class VoxelSampler:
    """Keeps at most ``limit`` points of any number; memory is proportional to ``limit``."""

    def __init__(self, limit: int):
        self._limit = limit
        self._xyz = np.zeros((0, 3))
        self._keys = np.zeros(0, np.uint64)  # Of the voxels of the points, sorted.
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
        colour = self._checked(chunk)
        new = self._in_new_voxels(xyz)
        self._xyz = np.concatenate([self._xyz, xyz[new]])
        if colour is not None:
            self._colour = np.concatenate([self._colour, colour[valid][new]])
        while len(self._xyz) > self._limit:
            self._set_voxel(2 * self._voxel)

    def result(self) -> PointCloud:
        """The points that were kept, in the order of the file."""
        rgb = self._rgb()
        coloured = np.full(len(self._xyz), rgb is not None)
        if rgb is None:
            rgb = np.zeros((len(self._xyz), 3), np.uint8)
        return PointCloud(self._xyz, rgb, coloured, self._num_read, self._num_invalid)

    def _checked(self, chunk: Chunk) -> NDArray[np.float32] | None:
        """The chunk's colours, if all points so far have one."""
        if chunk.colour is None:
            self._has_colour = False
            return None
        self._full = chunk.full
        low, high = float(chunk.colour.min()), float(chunk.colour.max())
        # NaN stays: such values are no colours.
        self._range = np.minimum(self._range[0], low), np.maximum(self._range[1], high)
        return chunk.colour if self._has_colour else None

    def _set_grid(self, xyz: NDArray[np.float64]) -> None:
        """Choose the first grid, and a coarser one if points are too far for hashes."""
        if self._voxel == 0:
            self._origin = xyz[0]
            self._voxel = _power_of_two(float(np.ptp(xyz, axis=0).max()) * _FINEST)
        reach = float(np.abs(xyz - self._origin).max())
        least = _power_of_two(reach * 2.0**-_BITS)
        if least > self._voxel:
            self._set_voxel(least)

    def _set_voxel(self, voxel: float) -> None:
        self._voxel = voxel
        keys, kept = np.unique(voxel_keys(self._xyz - self._origin, voxel), return_index=True)
        kept = np.sort(kept)
        self._keys, self._xyz = keys, self._xyz[kept]
        if self._has_colour:
            self._colour = self._colour[kept]

    def _in_new_voxels(self, xyz: NDArray[np.float64]) -> NDArray[np.intp]:
        """Sorted indices of the first point in each voxel that has no point yet."""
        keys = voxel_keys(xyz - self._origin, self._voxel)
        if len(self._keys):
            place = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
            candidates = np.flatnonzero(self._keys[place] != keys)
        else:
            candidates = np.arange(len(keys))
        new, first = np.unique(keys[candidates], return_index=True)
        self._keys = np.sort(np.concatenate([self._keys, new]))
        return np.sort(candidates[first])

    def _rgb(self) -> NDArray[np.uint8] | None:
        """Colours as bytes; None if there are none, or values that cannot be colours."""
        low, high = self._range
        if not self._has_colour or not 0 <= low <= high <= 65535:
            return None
        full = self._full
        if full is None:
            full = 1.0 if high <= 1 else 255.0 if high <= 255 else 65535.0
        return np.rint(np.clip(self._colour / full, 0, 1) * 255).astype(np.uint8)


def voxel_keys(
    xyz: NDArray[np.float64], voxel: float, grid: NDArray[np.uint64] | None = None
) -> NDArray[np.uint64]:
    """A hash of the voxel of side ``voxel`` that each point is in.

    Args:
        xyz: The (N, 3) finite points, fewer than 2^62 voxels from the origin.
        grid: The number (N,) of the grid that each point belongs to.
    """
    # Two of a million voxels have the same hash with a probability of 1e-7.
    key = np.zeros(len(xyz), np.uint64) if grid is None else grid * np.uint64(_MIX[0])
    for axis, factor in enumerate(_MIX):
        cell = np.floor(xyz[:, axis] / voxel).astype(np.int64).view(np.uint64)
        key = (key ^ cell) * np.uint64(factor)
        key ^= key >> np.uint64(31)
    return key


def first_in_voxels(
    xyz: NDArray[np.float64], voxel: float, grid: NDArray[np.uint64] | None = None
) -> NDArray[np.intp]:
    """Sorted indices of the first point in each voxel; see ``voxel_keys``."""
    return np.sort(np.unique(voxel_keys(xyz, voxel, grid), return_index=True)[1])


def thinned(
    xyz: NDArray[np.float64], limit: int, size: NDArray[np.float64] | None = None
) -> NDArray[np.intp]:
    """Sorted indices of at most ``limit`` points, one a voxel of the smallest grid found by
    bisection that has so few voxels.

    Args:
        size: (N,) positive, relative side of the voxel at each point, which is rounded down to
            powers of two; None: equal sides.
    """
    if len(xyz) <= limit:
        return np.arange(len(xyz))
    local, grid = xyz - xyz[0], None
    if size is not None:
        level = np.floor(np.log2(size / np.median(size))).clip(-_LEVELS, _LEVELS)
        local = local / np.exp2(level)[:, None]
        grid = level.astype(np.int64).view(np.uint64)
    high = 2 * float(np.abs(local).max())
    if high == 0:
        return np.zeros(1, np.intp)
    low = high * 2.0**-_BITS
    best = first_in_voxels(local, high, grid)[:limit]
    for _ in range(_STEPS):
        middle = float(np.sqrt(low * high))
        found = first_in_voxels(local, middle, grid)
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
