"""Points in views: projection, and occlusion by other points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.scene.views import View

# Occlusion: side of the cells of a coarse depth map in pixels, and the share by which a visible
# point may be behind the nearest one in its cell.
_CELL, _BEHIND = 8, 1.05
_SAMPLES = 5000


class Projection(NamedTuple):
    """Points in a view.

    Attributes:
        xy: (N, 2) float64 pixels; meaningless behind the camera.
        z: (N,) float64 camera z, world units.
        inside: (N,) bool, whether the image contains the point, be it hidden or not.
    """

    xy: NDArray[np.float64]
    z: NDArray[np.float64]
    inside: NDArray[np.bool_]


def projected(xyz: NDArray[np.float64], view: View) -> Projection:
    """Project (N, 3) points of the world."""
    # Use einsum, not a matrix product: BLAS may round differently with the number of threads.
    local = np.einsum("ij,nj->ni", view.world_to_camera[:3, :3], xyz)
    local += view.world_to_camera[:3, 3]
    z = local[:, 2]
    front = z > 0
    with np.errstate(over="ignore"):
        xy = local[:, :2] / np.where(front, z, 1.0)[:, None] * (view.fx, view.fy)
        xy += (view.cx, view.cy)
    inside = front & ((xy >= 0) & (xy < (view.width, view.height))).all(1)
    return Projection(xy, z, inside)


def seen_share(xyz: NDArray[np.float64], views: Sequence[View]) -> float:
    """The mean share of ``views`` whose image contains a point, hidden or not; 1 without points.

    Of more than twice ``_SAMPLES`` points (N, 3), it is that of an even sample.
    """
    sample = xyz[:: max(1, len(xyz) // _SAMPLES)]
    if not len(sample) or not views:
        return 1.0
    inside = sum(int(projected(sample, view).inside.sum()) for view in views)
    return inside / (len(sample) * len(views))


def visible(found: Projection, view: View) -> NDArray[np.intp]:
    """Indices of the points that no other point hides, by the nearest depth in cells of the
    image."""
    inside = np.flatnonzero(found.inside)
    column, row = (found.xy[inside] // _CELL).astype(np.intp).T
    depth = np.full((view.height // _CELL + 1, view.width // _CELL + 1), np.inf)
    np.minimum.at(depth, (row, column), found.z[inside])
    return np.asarray(inside[found.z[inside] < _BEHIND * depth[row, column]])
