"""Depth range and first planes of a view from the sparse points that it sees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.scene.views import View
from pipeline.scene.visibility import projected

# The range of depths: shares of the sparse points' depths, and factors beyond their quantiles.
# Points are missing where texture is.
QUANTILES, BEYOND = (0.01, 0.99), (0.5, 2.0)
# Without points: range of depth in distances to the sources.
BASELINES = 0.7, 60.0
# Number of points that determine a gradient, with the point itself.
NEIGHBOURS = 8
# With fewer points, their depths do not limit the range.
MIN_POINTS = 8


def depth_range(
    view: View, sources: Sequence[View], xyz: NDArray[np.float64]
) -> tuple[float, float]:
    """Smallest and largest camera z of surfaces in a view, world units.

    Args:
        xyz: (N, 3) the sparse points that it sees.
    """
    z = projected(xyz, view).z if len(xyz) else np.zeros(0)
    z = z[np.isfinite(z) & (z > 0)]
    if len(z) >= MIN_POINTS:
        near, far = np.quantile(z, QUANTILES).tolist()
        return BEYOND[0] * near, BEYOND[1] * far
    baseline = float(np.median([np.linalg.norm(s.centre - view.centre) for s in sources]))
    return BASELINES[0] * baseline, BASELINES[1] * baseline


def first_planes(
    view: View, xyz: NDArray[np.float64], depths: tuple[float, float]
) -> NDArray[np.float32]:
    """(3, H, W) planes of the view's pixels: inverse depth and its gradient per pixel.

    Each pixel has the plane of the nearest projected point: through the point, with the gradient
    of the inverse depths of its neighbours.

    Args:
        view: The view at the size of the planes.
        xyz: (N, 3) the sparse points that it sees.
        depths: The range of depth; points outside are not used.
    """
    from scipy.spatial import cKDTree

    planes = np.zeros((3, view.height, view.width), np.float32)
    planes[0] = 0.5 / depths[0] + 0.5 / depths[1]
    if not len(xyz):
        return planes
    found = projected(xyz, view)
    use = found.inside & (found.z >= depths[0]) & (found.z <= depths[1])
    xy, inverse = found.xy[use], 1.0 / found.z[use]
    if not len(xy):
        return planes
    column, row = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    pixels = np.column_stack([column.ravel(), row.ravel()])
    tree = cKDTree(xy)
    nearest = tree.query(pixels)[1]
    gradient = _gradients(xy, inverse, tree.query(xy, min(NEIGHBOURS, len(xy)))[1])[nearest]
    value = inverse[nearest] + (gradient * (pixels - xy[nearest])).sum(1)
    planes[0] = value.clip(1 / depths[1], 1 / depths[0]).reshape(view.height, view.width)
    planes[1:] = gradient.T.reshape(2, view.height, view.width)
    return planes


def _gradients(
    xy: NDArray[np.float64], inverse: NDArray[np.float64], neighbours: NDArray[np.intp]
) -> NDArray[np.float64]:
    """(N, 2) least-squares gradients of inverse depths (N,) in the neighbours (N, k) of each point;
    near 0 where these are on a line.

    In closed form: LAPACK's threads take longer than its arithmetic for small matrices.
    """
    neighbours = neighbours.reshape(len(xy), -1)
    offset, change = xy[neighbours] - xy[:, None], inverse[neighbours] - inverse[:, None]
    xx, xy_, yy = ((offset[..., i] * offset[..., j]).sum(1) for i, j in ((0, 0), (0, 1), (1, 1)))
    ridge = 1e-2 * (xx + yy) + 1e-12
    xx, yy = xx + ridge, yy + ridge
    x, y = ((offset[..., i] * change).sum(1) for i in (0, 1))
    determinant = xx * yy - xy_**2
    return np.column_stack([yy * x - xy_ * y, xx * y - xy_ * x]) / determinant[:, None]
