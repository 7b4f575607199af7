"""Depths that are known before training: those of sparse points in the views that see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View
from pipeline.scene.visibility import projected, visible

#: Upper limit of the scene's scale, in median depths of the sparse points.
SCALE_SHARE = 0.5


@dataclass(frozen=True)
class KnownDepths:
    """Known depths of one view.

    Attributes:
        xy: (M, 2) float64 pixels of the view at its full size.
        z: (M,) float32 camera z, world unit, positive.
        weight: (M,) float32, mean 1.
    """

    xy: NDArray[np.float64]
    z: NDArray[np.float32]
    weight: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.z)


def point_depths(views: Sequence[View], model: Reconstruction) -> list[KnownDepths]:
    """The depths of the sparse points of ``model`` in each of ``views`` that sees them.

    The weight of a point is its track length, at most eight: points of two views are often wrong.
    """
    points = model.points
    observed = model.observed_points(view.name for view in views)
    found = []
    for view, here in zip(views, observed, strict=True):
        # Use einsum, not a matrix product: BLAS may round differently with the number of threads.
        camera = np.einsum("ij,nj->ni", view.world_to_camera[:3, :3], points.xyz[here])
        camera += view.world_to_camera[:3, 3]
        z = camera[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = camera[:, :2] / z[:, None] * (view.fx, view.fy) + (view.cx, view.cy)
        inside = (z > 0) & (xy >= 0).all(1) & (xy < (view.width, view.height)).all(1)
        weight = np.minimum(points.track_length[here[inside]], 8).astype(np.float32)
        weight /= max(float(weight.mean()), 1e-6) if len(weight) else 1.0
        found.append(KnownDepths(xy[inside], z[inside].astype(np.float32), weight))
    return found


def gaussian_depths(views: Sequence[View], means: NDArray[np.float64]) -> list[KnownDepths]:
    """The depths of Gaussians in each of ``views``, of those that no other one hides.

    Args:
        means: (N, 3) centres in the world.
    """
    known = []
    for view in views:
        found = projected(means, view)
        rows = visible(found, view)
        ones = np.ones(len(rows), np.float32)
        known.append(KnownDepths(found.xy[rows], found.z[rows].astype(np.float32), ones))
    return known


def scene_scale(extent: float, known: Sequence[KnownDepths]) -> float:
    """Unit of the means' learning rate and of thresholds of scales, world units: the extent, but at
    most half the median known depth.

    3DGS uses the extent. Cameras along a street have an extent of many times the depth of what they
    see, and steps of that size pass through surfaces.
    """
    depths = np.concatenate([view.z for view in known]) if known else np.zeros(0)
    return min(extent, SCALE_SHARE * float(np.median(depths))) if len(depths) else extent
