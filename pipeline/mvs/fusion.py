"""Fusion of filtered depth maps into a point cloud with each surface point once.

A pixel becomes a point if no other view that has the same point sees it with more pixels per unit
of length; equal ones are ordered by index. The point is the mean of the views that agree.
Views are fused independently of each other, in bounded memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.mvs.consistency import FilterOptions, PlaneMap, compare
from pipeline.mvs.maps import DenseCloud, DenseMap
from pipeline.mvs.patchmatch import relative_pose
from pipeline.scene.views import View

# Pixels with less confidence are not fused.
MIN_CONFIDENCE = 0.25
# Subsampling does not depend on the run's seed.
SEED = 0


def symmetric(neighbours: Sequence[NDArray[np.intp]]) -> list[list[int]]:
    """The neighbours of each view, and the views of which it is a neighbour, ascending."""
    found: list[set[int]] = [set(map(int, items)) for items in neighbours]
    for index, items in enumerate(neighbours):
        for other in items:
            found[int(other)].add(index)
    return [sorted(items) for items in found]


def fused_points(
    index: int,
    views: Sequence[View],
    neighbours: Sequence[int],
    own: DenseMap,
    rgb: NDArray[np.uint8],
    read: Callable[[int], PlaneMap],
    options: FilterOptions,
    limit: int,
) -> DenseCloud:
    """The points of the cloud that a view contributes.

    Args:
        index: The index of the view in ``views``.
        neighbours: The indices of the views to compare with.
        own: The view's filtered map.
        rgb: (H, W, 3) its colours.
        read: Returns the filtered planes of a view by its index.
        limit: The largest number of points; of more, a random subset is kept.
    """
    view = views[index]
    row, column = np.nonzero(own.confidence >= MIN_CONFIDENCE)
    inverse = 1.0 / own.depth[row, column].astype(np.float64)
    xy = np.column_stack([column + 0.5, row + 0.5])
    count = np.ones(len(row))
    total = inverse.copy()
    kept = np.ones(len(row), bool)
    for other in neighbours:
        found = compare(view, xy, inverse, read(other), options)
        count += found.agrees
        total += np.where(found.agrees, found.inverse_depth, 0.0)
        finer = _finer_by(view, views[other], xy, inverse)
        kept &= ~(found.agrees & ((finer > 0) | ((finer == 0) & (other < index))))
    chosen = np.flatnonzero(kept)
    if len(chosen) > limit:
        generator = np.random.Generator(np.random.PCG64([SEED, index]))
        chosen = chosen[np.sort(generator.choice(len(chosen), limit, replace=False))]
    row, column = row[chosen], column[chosen]
    local = _rays(view, xy[chosen]) * (count / total)[chosen, None]
    rotation, translation = view.world_to_camera[:3, :3], view.world_to_camera[:3, 3]
    xyz = np.einsum("ji,nj->ni", rotation, local - translation)
    normals = np.einsum("ji,nj->ni", rotation, own.normals[row, column].astype(np.float64))
    return DenseCloud(xyz.astype(np.float32), normals.astype(np.float32), rgb[row, column])


def joined(parts: Sequence[DenseCloud]) -> DenseCloud:
    """The clouds as one."""
    empty = DenseCloud(
        np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    )
    columns = zip(*(vars(part).values() for part in (empty, *parts)), strict=True)
    return DenseCloud(*map(np.concatenate, columns))


def _rays(view: View, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) rays of pixels in camera coordinates, with z = 1."""
    x, y = (xy[:, 0] - view.cx) / view.fx, (xy[:, 1] - view.cy) / view.fy
    return np.column_stack([x, y, np.ones(len(xy))])


def _finer_by(
    view: View, other: View, xy: NDArray[np.float64], inverse_depth: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N,) how much finer the other view sees each point, in pixels per unit of length: the
    logarithm of the ratio.

    Rounded to steps of 0.1 %, so that rounding errors do not order views with equal resolution.
    """
    local = _rays(view, xy) / inverse_depth[:, None]
    rotation, translation = relative_pose(view, other)
    z = np.einsum("j,nj->n", rotation[2], local) + translation[2]
    focal = np.sqrt(other.fx * other.fy / (view.fx * view.fy))
    ratio = focal / (np.maximum(z, 1e-12) * inverse_depth)
    return np.rint(1000 * np.log(np.maximum(ratio, 1e-12)))
