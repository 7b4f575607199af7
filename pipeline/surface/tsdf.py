"""Depth maps fused to a truncated signed distance field (Curless and Levoy 1996), stored only near
the surface, in blocks of 8^3 voxels, sorted by position.

World frame, COLMAP cameras. No matrix products: BLAS rounds differently with the number of threads.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from pipeline.config.section import MAX_MESH_VOXELS
from pipeline.scene.views import View
from pipeline.surface.depth import DepthMap

#: Side of a block in voxels.
BLOCK = 8
#: Truncation distance in voxels: above the noise of the depths, below the width of thin objects.
TRUNCATION = 6.0
#: Default side of a voxel, in pixels at the median depth.
PIXELS_PER_VOXEL = 2.5
#: Depths beyond this multiple of the median depth contribute no surface: pixels are too coarse.
FAR = 3.0
#: Weight of an observation of free space; one of a surface weighs 1. Below 1, so that rays through
#: gaps between Gaussians do not erase surfaces that other views see.
FREE_SPACE_WEIGHT = 0.2

_BLOCKS_PER_TASK = 256
# Block coordinates are packed into one integer, 21 bits each.
_BITS, _OFFSET = 21, 1 << 20
# Radius in pixels around a block's centre over which the maximum depth is taken.
_REACH = 24

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Grid:
    """The voxels: those of ``blocks``.

    Attributes:
        voxel: The side of a voxel, world units. Voxel (i, j, k) has its centre at (i, j, k) *
            voxel.
        far: The largest depth that counts as a surface, world units. A greater one proves only that
            the space up to ``far`` is free.
        blocks: (B, 3) int64, sorted; block b holds voxels b * 8 to b * 8 + 7.
    """

    voxel: float
    far: float
    blocks: NDArray[np.int64]

    @property
    def truncation(self) -> float:
        return TRUNCATION * self.voxel


@dataclass(frozen=True)
class Tsdf:
    """The fused field.

    Attributes:
        grid: The voxels.
        distance: (B, 8, 8, 8) float32, mean signed distance over the truncation, -1 to 1, positive
            in front of the surface; 0 where the weight is 0.
        weight: (B, 8, 8, 8) float32, sum of the weights of the views that saw a surface there, plus
            ``FREE_SPACE_WEIGHT`` times those of the views that saw free space.
    """

    grid: Grid
    distance: NDArray[np.float32]
    weight: NDArray[np.float32]


def choose_grid(depths: Iterable[DepthMap], voxel: float | None) -> Grid | None:
    """Choose the blocks within the truncation distance of the observed surface.

    Args:
        depths: The depth maps; iterated over several times.
        voxel: The side of a voxel, world units; None takes ``PIXELS_PER_VOXEL`` at the median
            depth. Either is enlarged if ``MAX_MESH_VOXELS`` would be exceeded, or if blocks are
            narrower than a pixel.

    Returns:
        None if no map has a depth.
    """
    median, width = _median_depth(depths)
    if median == 0:
        return None
    far = FAR * median
    # A block narrower than a pixel would leave gaps between the pixels' blocks.
    side = PIXELS_PER_VOXEL * width if voxel is None else max(voxel, width / BLOCK)
    while True:
        # Blocks are searched again for each size: their number depends on the surface.
        keys = np.zeros(0, np.int64)
        for depth in depths:
            keys = np.union1d(keys, _surface_blocks(depth, side, far))
            if len(keys) * BLOCK**3 > MAX_MESH_VOXELS:
                break
        else:
            return Grid(side, far, _unpack(keys))
        side *= 1.15


def fuse(grid: Grid, depths: Iterable[DepthMap], threads: int) -> Tsdf:
    """Fuse depth maps; the same bits at any number of threads."""
    shape = (len(grid.blocks), BLOCK**3)
    total, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    with ThreadPoolExecutor(max(1, threads)) as pool:
        for depth in depths:
            rows = _visible_blocks(grid, depth)
            parts = [rows[i : i + _BLOCKS_PER_TASK] for i in range(0, len(rows), _BLOCKS_PER_TASK)]
            for _ in pool.map(partial(_integrate, grid, depth, total, weight), parts):
                pass
    np.divide(total, weight, out=total, where=weight > 0)
    cube = (-1, BLOCK, BLOCK, BLOCK)
    return Tsdf(grid, total.reshape(cube), weight.reshape(cube))


def _median_depth(depths: Iterable[DepthMap]) -> tuple[float, float]:
    """Medians over all pixels of the depth and of a pixel's width there; 0 without any depth."""
    values, widths = [np.zeros(0, np.float32)], [np.zeros(0, np.float32)]
    for depth in depths:
        z = depth.surface(np.inf)[::4, ::4]
        values.append(z[z > 0])
        widths.append(values[-1] * np.float32(2 / (depth.view.fx + depth.view.fy)))
    if not any(map(len, values)):
        return 0.0, 0.0
    return float(np.median(np.concatenate(values))), float(np.median(np.concatenate(widths)))


def _pack(blocks: NDArray[np.int64]) -> NDArray[np.int64]:
    x, y, z = (np.clip(blocks[..., i] + _OFFSET, 0, 2 * _OFFSET - 1) for i in range(3))
    return np.asarray((x << 2 * _BITS) | (y << _BITS) | z)


def _unpack(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    mask = (1 << _BITS) - 1
    parts = [keys >> 2 * _BITS, (keys >> _BITS) & mask, keys & mask]
    return np.stack(parts, axis=-1) - _OFFSET


def _surface_blocks(depth: DepthMap, voxel: float, far: float) -> NDArray[np.int64]:
    """Keys of the blocks that contain points of the map's surface, or points one truncation
    distance in front of or behind it."""
    view, z = depth.view, depth.surface(far)
    rows, columns = np.nonzero(z > 0)
    z = z[rows, columns].astype(np.float64)
    x, y = (columns + 0.5 - view.cx) / view.fx, (rows + 0.5 - view.cy) / view.fy
    rotation, centre = view.world_to_camera[:3, :3], view.centre
    length = np.sqrt(x * x + y * y + 1)
    keys = []
    for shift in (-TRUNCATION * voxel, 0.0, TRUNCATION * voxel):
        reach = z + shift / length
        blocks = [
            np.floor(
                (centre[i] + reach * (x * rotation[0, i] + y * rotation[1, i] + rotation[2, i]))
                / (BLOCK * voxel)
                + 0.5 / BLOCK
            ).astype(np.int64)
            for i in range(3)
        ]
        keys.append(np.unique(_pack(np.stack(blocks, axis=-1))))
    return np.unique(np.concatenate(keys))


def camera_space(view: View, points: NDArray[Any]) -> tuple[Array, Array, Array]:
    """x, y, z of (N, 3) world points in the camera frame."""
    rotation, shift = view.world_to_camera[:3, :3], view.world_to_camera[:3, 3]
    px, py, pz = points[:, 0], points[:, 1], points[:, 2]
    x, y, z = (
        rotation[i, 0] * px + rotation[i, 1] * py + rotation[i, 2] * pz + shift[i] for i in range(3)
    )
    return x, y, z


def project_to_pixels(
    view: View, x: NDArray[Any], y: NDArray[Any], z: NDArray[Any]
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Project points in the camera frame: index of the pixel in the flattened image (0 for points
    outside), and whether the point is inside."""
    front = np.maximum(z, 1e-9)
    u, v = view.fx * x / front + view.cx, view.fy * y / front + view.cy
    seen = (z > 0) & (u >= 0) & (v >= 0) & (u < view.width) & (v < view.height)
    column, row = np.where(seen, u, 0).astype(np.int32), np.where(seen, v, 0).astype(np.int32)
    return row * np.int32(view.width) + column, seen


def _visible_blocks(grid: Grid, depth: DepthMap) -> NDArray[np.intp]:
    """Rows of the blocks that may be visible: inside the image and not behind its surface."""
    view, size = depth.view, BLOCK * grid.voxel
    radius = size * np.sqrt(3) / 2
    centres = (grid.blocks + (0.5 - 0.5 / BLOCK)) * size
    x, y, z = camera_space(view, centres)
    front = np.maximum(z, 1e-9)
    u, v = view.fx * x / front + view.cx, view.fy * y / front + view.cy
    # Upper bound of the projected radius of a block of radius r, for z > 2 r.
    spread = 2 * max(view.fx, view.fy) * radius / front
    close = (z > -radius) & (z < 2 * radius)
    inside = (z >= 2 * radius) & (u > -spread) & (v > -spread)
    inside &= (u < view.width + spread) & (v < view.height + spread)
    farthest = maximum_filter(depth.depth, 2 * _REACH + 1, mode="nearest")
    column = np.clip(u, 0, view.width - 1).astype(np.intp)
    row = np.clip(v, 0, view.height - 1).astype(np.intp)
    occluded = (spread < _REACH) & (z - radius > farthest[row, column] + grid.truncation)
    return np.flatnonzero(close | (inside & ~occluded))


def _integrate(
    grid: Grid,
    depth: DepthMap,
    total: NDArray[np.float32],
    weight: NDArray[np.float32],
    rows: NDArray[np.intp],
) -> None:
    """Add one map to the blocks ``rows``."""
    view, voxel = depth.view, grid.voxel
    corner = camera_space(view, grid.blocks[rows] * (BLOCK * voxel))
    offsets = np.indices((BLOCK, BLOCK, BLOCK)).reshape(3, -1).T * voxel
    rotation = view.world_to_camera[:3, :3]
    x, y, z = (
        (
            corner[i][:, None]
            + (
                rotation[i, 0] * offsets[:, 0]
                + rotation[i, 1] * offsets[:, 1]
                + rotation[i, 2] * offsets[:, 2]
            )[None]
        ).astype(np.float32)
        for i in range(3)
    )
    pixel, seen = project_to_pixels(view, x, y, z)
    found = depth.depth.reshape(-1)[pixel]
    share = (found - z) * np.float32(1 / grid.truncation)
    seen &= (found > 0) & (share > -1)
    # Depths beyond ``far`` only prove free space.
    seen &= (found < grid.far) | (share > 1)
    each = np.float32(1) if depth.weight is None else depth.weight.reshape(-1)[pixel]
    contribution = seen * each * np.where(share > 1, np.float32(FREE_SPACE_WEIGHT), np.float32(1))
    weight[rows] += contribution
    total[rows] += contribution * np.clip(share, -1, 1)


def chunks(grid: Grid, side: int) -> Iterator[tuple[NDArray[np.int64], NDArray[np.intp]]]:
    """Non-empty chunks of ``side``^3 blocks: coordinates (3,) of the first block, and rows of the
    blocks in the chunk and of the adjacent ones that complete its last cells."""
    packed = np.unique(_pack(grid.blocks // side))
    for first in _unpack(packed) * side:
        inside = np.all((grid.blocks >= first) & (grid.blocks <= first + side), axis=1)
        yield first, np.flatnonzero(inside)
