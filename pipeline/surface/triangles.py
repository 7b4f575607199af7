"""A rasterizer of triangles: the nearest triangle of each pixel.

A triangle covers the pixels whose centres are inside it; a centre on an edge that two triangles
share belongs to one of them. The order of the triangles has no influence.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Rows of triangles, and pixels, that are in memory at a time.
_ROWS, _PIXELS = 1 << 17, 1 << 19


class Drawn(NamedTuple):
    """What is seen in each pixel.

    Attributes:
        face: (H, W) int32 index of the nearest triangle; -1 without one.
        inverse_depth: (H, W) float32 1 / z of it; 0 without one.
    """

    face: NDArray[np.int32]
    inverse_depth: NDArray[np.float32]


def draw_triangles(
    xy: Array, inverse_depth: Array, faces: NDArray[np.integer], width: int, height: int
) -> Drawn:
    """Draw triangles with their corners at pixels ``xy``.

    Args:
        xy: (V, 2), the centre of the upper left pixel is (0.5, 0.5).
        inverse_depth: (V,) 1 / z, which is affine in a triangle's image. Triangles with a corner
            where it is not positive are not drawn.
        faces: (F, 3) either orientation.
    """
    # Depth and index as one integer, whose maximum is the nearest: positive floats are ordered as
    # their bits.
    nearest = np.zeros(height * width, np.uint64)
    index = np.flatnonzero((inverse_depth[faces] > 0).all(axis=1)) if len(faces) else faces[:, 0]
    corners = xy[faces[index]]
    low, high = corners.min(axis=1), corners.max(axis=1)
    inside = (high > 0).all(axis=1) & (low < (width, height)).all(axis=1)
    index, corners = index[inside], corners[inside]
    values = inverse_depth[faces[index]]
    plane, least, largest = _planes(corners, values), values.min(axis=1), values.max(axis=1)
    for triangle, row, column in _pixels(corners, width, height):
        offset, slope_x, slope_y = plane[triangle].T
        value = offset + slope_x * (column + 0.5) + slope_y * (row + 0.5)
        # A triangle in edge view has no meaningful slope.
        value = np.clip(value, least[triangle], largest[triangle])
        bits = value.astype(np.float32).view(np.uint32).astype(np.uint64)
        code = (bits << np.uint64(32)) | index[triangle].astype(np.uint64)
        np.maximum.at(nearest, row * width + column, code)
    bits = (nearest >> np.uint64(32)).astype(np.uint32)
    face = (nearest & np.uint64(0xFFFFFFFF)).astype(np.int32)
    face[bits == 0] = -1
    shape = (height, width)
    return Drawn(face.reshape(shape), bits.view(np.float32).reshape(shape))


def barycentric(corners: Array, points: Array) -> Array:
    """(N, 3) barycentric coordinates of (N, 2) points in (N, 3, 2) triangles; outside they are
    those of a point of the triangle nearby."""
    a, b, c = (corners[:, i] for i in range(3))
    area = _cross(b - a, c - a)
    safe = np.where(area == 0, 1.0, area)
    v = np.where(area == 0, 0.0, _cross(points - a, c - a) / safe)
    w = np.where(area == 0, 0.0, _cross(b - a, points - a) / safe)
    weights = np.clip(np.column_stack([1 - v - w, v, w]), 0, 1)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _planes(corners: Array, values: Array) -> Array:
    """(F, 3) value at the origin and slopes of the affine functions with (F, 3) ``values`` at the
    corners."""
    a, b, c = (corners[:, i] for i in range(3))
    area = _cross(b - a, c - a)
    safe = np.where(area == 0, 1.0, area)
    first, second = values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]
    slope_x = (first * (c - a)[:, 1] - second * (b - a)[:, 1]) / safe
    slope_y = (second * (b - a)[:, 0] - first * (c - a)[:, 0]) / safe
    return np.column_stack([values[:, 0] - slope_x * a[:, 0] - slope_y * a[:, 1], slope_x, slope_y])


def _pixels(corners: Array, width: int, height: int) -> Iterator[tuple[NDArray[np.intp], ...]]:
    """Triangle, row and column of the covered pixels, in parts."""
    top = np.clip(np.ceil(corners[..., 1].min(axis=1) - 0.5), 0, height).astype(np.intp)
    bottom = np.clip(np.ceil(corners[..., 1].max(axis=1) - 0.5), 0, height).astype(np.intp)
    for triangle, row in _ranges(np.arange(len(corners)), top, bottom, _ROWS):
        left, right = _spans(corners[triangle], row.astype(np.float64) + 0.5)
        first = np.clip(np.ceil(left - 0.5), 0, width).astype(np.intp)
        last = np.clip(np.ceil(right - 0.5), 0, width).astype(np.intp)
        for span, column in _ranges(np.arange(len(row)), first, last, _PIXELS):
            yield triangle[span], row[span], column


def _ranges(
    items: NDArray[np.intp], first: NDArray[np.intp], end: NDArray[np.intp], limit: int
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Every item with each number from ``first`` to below ``end``, about ``limit`` at a time."""
    count = np.maximum(end - first, 0)
    items, first, count = items[count > 0], first[count > 0], count[count > 0]
    total = np.cumsum(count)
    start = 0
    while start < len(items):
        before = total[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(total, before + limit, "right")))
        part = slice(start, stop)
        repeated = np.repeat(np.arange(start, stop), count[part])
        step = np.arange(len(repeated)) - (total[repeated] - count[repeated] - before)
        yield items[repeated], first[repeated] + step
        start = stop


def _spans(corners: Array, y: Array) -> tuple[Array, Array]:
    """The least and the largest x of each triangle at height ``y``."""
    left, right = np.full(len(y), np.inf), np.full(len(y), -np.inf)
    for i in range(3):
        a, b = corners[:, i], corners[:, (i + 1) % 3]
        # The same order of the ends for both triangles at an edge: they round alike.
        swap = ((a[:, 1] > b[:, 1]) | ((a[:, 1] == b[:, 1]) & (a[:, 0] > b[:, 0])))[:, None]
        a, b = np.where(swap, b, a), np.where(swap, a, b)
        crosses = (a[:, 1] <= y) & (y < b[:, 1])
        rise = np.where(crosses, b[:, 1] - a[:, 1], 1.0)
        x = a[:, 0] + (y - a[:, 1]) * ((b[:, 0] - a[:, 0]) / rise)
        left = np.where(crosses, np.minimum(left, x), left)
        right = np.where(crosses, np.maximum(right, x), right)
    return np.where(left <= right, left, 0.0), np.where(left <= right, right, 0.0)
