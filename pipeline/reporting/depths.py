"""Coarse depth maps of cameras, from which the page's viewer derives where it may move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.io.splat_codec import sigmoid
from pipeline.splats.arrays import GaussianArrays

Array = NDArray[np.float64]

ROWS, COLUMNS = 12, 16
# Projections in all: the maps of many cameras use fewer Gaussians each.
_PROJECTIONS = 3_000_000
_SAMPLE = (2_000, 20_000)
# The optical depth at which half of the light is absorbed.
_HALF = np.log(2.0)

DEPTH_RATIO = 1.06
"""The ratio between successive codes of ``depth_codes``."""


def coarse_depths(
    gaussians: GaussianArrays, cameras: Sequence[dict[str, Any]], near: float
) -> Array:
    """The depth at which half of the light is absorbed, per cell of each camera's image.

    Each Gaussian is counted in the cell of its centre only, and of many Gaussians only a sample is
    used.

    Args:
        cameras: Pinholes in the format of ``space.upright_camera``.
        near: The near plane, world unit.

    Returns:
        (C, ROWS, COLUMNS); infinite where less is absorbed.
    """
    depths = np.full((len(cameras), ROWS, COLUMNS), np.inf)
    wanted = int(np.clip(_PROJECTIONS // max(len(cameras), 1), *_SAMPLE))
    step = max(len(gaussians) // wanted, 1)
    means = gaussians.means[::step].astype(np.float64)
    axes = np.sort(gaussians.log_scales[::step], axis=1)[:, 1:].sum(1, dtype=np.float64)
    # The area of the two longer axes that absorbs as a Gaussian does, world unit squared.
    areas = step * 2 * np.pi * np.exp(axes) * sigmoid(gaussians.opacity_logits[::step])
    for camera, depth in zip(cameras, depths, strict=True):
        _absorb(depth.reshape(-1), means, areas, camera, near)
    return depths


def _absorb(depth: Array, means: Array, areas: Array, camera: dict[str, Any], near: float) -> None:
    """Write the coarse depth map of one camera to ``depth``, (ROWS * COLUMNS,)."""
    pose = np.reshape(camera["world_to_camera"], (3, 4))
    local = means @ pose[:, :3].T + pose[:, 3]
    ahead = local[:, 2] > near
    x, y, z = local[ahead].T
    width, height, fx, fy = (camera[name] for name in ("width", "height", "fx", "fy"))
    column = np.floor((x / z * fx + camera["cx"]) / width * COLUMNS)
    row = np.floor((y / z * fy + camera["cy"]) / height * ROWS)
    inside = (column >= 0) & (column < COLUMNS) & (row >= 0) & (row < ROWS)
    cell = (row[inside] * COLUMNS + column[inside]).astype(np.intp)
    z = z[inside]
    share = areas[ahead][inside] * fx * fy / z**2 / (width * height / (ROWS * COLUMNS))
    order = np.lexsort((z, cell))
    cell, z, share = cell[order], z[order], np.minimum(share[order], 1)
    total = np.cumsum(share)
    start = np.searchsorted(cell, np.arange(len(depth)))
    before = np.concatenate([[0.0], total])[start]
    reached = np.searchsorted(total, before + _HALF)
    found = (reached < len(cell)) & (start < len(cell))
    found[found] = cell[reached[found]] == np.flatnonzero(found)
    depth[found] = z[reached[found]]


def depth_codes(depths: Array, first: float) -> NDArray[np.uint8]:
    """Depths as logarithmic codes: ``first * DEPTH_RATIO ** (code - 1)``; 0 for infinite ones."""
    finite = np.isfinite(depths)
    steps = np.log(np.where(finite, depths, first) / first) / np.log(DEPTH_RATIO)
    return np.where(finite, np.clip(np.rint(steps) + 1, 1, 255), 0).astype(np.uint8)
