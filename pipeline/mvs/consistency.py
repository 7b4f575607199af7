"""Geometric consistency of depth maps: agreement with those of other views, confidence, speckles.

A pixel's point is projected into another view; the point that this view has there is projected
back. The views agree if it returns near the pixel with a similar depth (Schönberger et al. 2016).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.mvs.patchmatch import relative_projection
from pipeline.scene.views import View


@dataclass(frozen=True)
class PlaneMap:
    """Planes of a view's pixels.

    Attributes:
        view: The camera.
        planes: (3, H, W) float32 inverse depth at the pixel's centre and its gradient per pixel;
            inverse depth 0 without a plane.
    """

    view: View
    planes: NDArray[np.float32]


@dataclass(frozen=True)
class FilterOptions:
    """Parameters of the filter.

    Attributes:
        max_error: The largest distance between a pixel and its image after the round trip, pixels.
        max_depth_error: The largest relative difference of depths.
        min_views: The number of other views that must agree. One is enough where the others see
            nothing behind the point.
        max_cost: The largest matching cost.
        min_speckle: The size in pixels below which connected regions are removed.
    """

    max_error: float = 1.0
    max_depth_error: float = 0.01
    min_views: int = 2
    max_cost: float = 0.7
    min_speckle: int = 40


@dataclass(frozen=True)
class Agreement:
    """Pixels of a reference view compared with another view.

    Attributes:
        agrees: (N,) bool, the other view has the same point.
        sees_behind: (N,) bool, the other view has a point behind that of the reference, which
            would hide it.
        inverse_depth: (N,) float64 inverse depth in the reference of the other view's point.
        index: (N,) flat index of the other view's pixel; 0 outside its image.
    """

    agrees: NDArray[np.bool_]
    sees_behind: NDArray[np.bool_]
    inverse_depth: NDArray[np.float64]
    index: NDArray[np.intp]


def compare(
    view: View,
    xy: NDArray[np.float64],
    inverse_depth: NDArray[np.float64],
    other: PlaneMap,
    options: FilterOptions,
) -> Agreement:
    """Compare points of a view with the planes of another one.

    Args:
        xy: (N, 2) pixels of the view.
        inverse_depth: (N,) positive.
    """
    at = _projected(view, other.view, xy, inverse_depth)
    front = at[2] > 1e-12
    scale = np.where(front, at[2], 1.0)
    u, v = at[0] / scale, at[1] / scale
    inside = front & (u >= 0) & (v >= 0) & (u < other.view.width) & (v < other.view.height)
    column = np.where(inside, u, 0.0).astype(np.intp)
    row = np.where(inside, v, 0.0).astype(np.intp)
    w, wx, wy = (plane[row, column].astype(np.float64) for plane in other.planes)
    found = inside & (w > 0)
    w = w + (u - column - 0.5) * wx + (v - row - 0.5) * wy
    found &= w > 0
    w = np.where(found, w, 1.0)
    returned = _projected(other.view, view, np.column_stack([u, v]), w)
    found &= returned[2] > 1e-12
    scale = np.where(found, returned[2], 1.0)
    dx, dy = returned[0] / scale - xy[:, 0], returned[1] / scale - xy[:, 1]
    # Depth in the reference of the other view's point, over that of the reference's own point.
    ratio = scale / w * inverse_depth
    near = np.abs(ratio - 1.0) <= options.max_depth_error
    agrees = found & near & (dx * dx + dy * dy <= options.max_error**2)
    # Depth of the other view's point over that of the reference's point, in the other view.
    behind = inverse_depth / (np.where(front, at[2], 1.0) * w) > 1.0 + 3 * options.max_depth_error
    index = np.where(inside, row * other.view.width + column, 0)
    return Agreement(agrees, found & behind, w / scale, index)


def filtered(
    reference: PlaneMap,
    costs: NDArray[np.float32],
    others: Iterable[PlaneMap],
    options: FilterOptions,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Remove pixels that other views do not confirm, and small regions.

    Args:
        costs: (H, W) matching costs.

    Returns:
        (H, W) inverse depth, the mean of the reference and the views that agree, and confidence in
        [0, 1]; 0 for removed pixels.
    """
    shape = costs.shape
    row, column = np.nonzero(reference.planes[0] > 0)
    inverse = reference.planes[0][row, column].astype(np.float64)
    xy = np.column_stack([column + 0.5, row + 0.5])
    count = np.zeros(len(row), np.intp)
    behind = np.zeros(len(row), np.intp)
    total = inverse.copy()
    for other in others:
        found = compare(reference.view, xy, inverse, other, options)
        count += found.agrees
        behind += found.sees_behind
        total += np.where(found.agrees, found.inverse_depth, 0.0)
    cost = costs[row, column]
    kept = (count >= options.min_views) | ((count == 1) & (behind == 0))
    kept &= cost <= options.max_cost
    result = np.zeros(shape, np.float32)
    result[row[kept], column[kept]] = (total / (1 + count))[kept]
    speckles = speckle_mask(result, options)
    result[speckles] = 0
    trust = np.zeros(shape, np.float32)
    trust[row, column] = confidence(count, behind, cost)
    trust[result == 0] = 0
    return result, trust


def confidence(
    count: NDArray[np.intp], behind: NDArray[np.intp], cost: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(N,) confidence in [0, 1]: grows with the number of views that agree, and falls with the
    number of views that see something behind the point and with the matching cost."""
    agreement = (1.0 - 0.5**count) * (1 + count) / (1 + count + behind)
    return np.asarray(agreement * np.clip(1.0 - cost, 0.0, 1.0), np.float32)


def speckle_mask(inverse_depth: NDArray[np.float32], options: FilterOptions) -> NDArray[np.bool_]:
    """(H, W) whether a pixel belongs to a connected region of fewer than ``min_speckle`` pixels.

    Neighbours are connected if their depths differ by less than twice ``max_depth_error``.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    height, width = inverse_depth.shape
    index = np.arange(height * width).reshape(height, width)
    limit = 2 * options.max_depth_error
    pairs = []
    for first, second in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1], np.s_[1:]),
    ):
        a, b = inverse_depth[first], inverse_depth[second]
        linked = (a > 0) & (b > 0) & (np.abs(a - b) <= limit * np.minimum(a, b))
        pairs.append(np.stack([index[first][linked], index[second][linked]]))
    edges = np.concatenate(pairs, axis=1)
    ones = np.ones(edges.shape[1], np.int8)
    graph = coo_matrix((ones, (edges[0], edges[1])), shape=(index.size, index.size))
    labels = connected_components(graph, directed=False)[1]
    sizes = np.bincount(labels)
    return np.asarray((sizes[labels] < options.min_speckle).reshape(height, width))


def _projected(
    view: View, other: View, xy: NDArray[np.float64], w: NDArray[np.float64]
) -> list[NDArray]:
    """Pixels (N, 2) with inverse depths (N,) to homogeneous pixels of another view, (3, N)."""
    r, t = relative_projection(view, other)
    return [r[k, 0] * xy[:, 0] + r[k, 1] * xy[:, 1] + r[k, 2] + t[k] * w for k in range(3)]
