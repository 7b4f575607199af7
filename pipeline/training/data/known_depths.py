"""Depths that are known before training: of sparse points, where views see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View

#: Of the middle of what views see, the most that lengths of a training are measured by.
SCALE_SHARE = 0.5


@dataclass(frozen=True)
class KnownDepths:
    """What is known of one view.

    Attributes:
        xy: (M, 2) float64 pixels of the view at its full size.
        z: (M,) float32 camera z, world unit, positive.
        weight: (M,) float32, of mean 1.
    """

    xy: NDArray[np.float64]
    z: NDArray[np.float32]
    weight: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.z)


def point_depths(views: Sequence[View], model: Reconstruction) -> list[KnownDepths]:
    """The depths of the sparse points of ``model`` in each of ``views`` that sees them.

    A point counts by the number of its views, at most eight: what two views made is often wrong.
    """
    points = model.points
    owner = np.repeat(np.arange(len(points)), points.track_length)
    order = np.argsort(points.track_image_id, kind="stable")
    ids = points.track_image_id[order]
    numbers = {image.name: number for number, image in model.images.items()}
    found = []
    for view in views:
        number = numbers[view.name]
        here = owner[order[np.searchsorted(ids, number) : np.searchsorted(ids, number, "right")]]
        # einsum, not a product of matrices: BLAS may round by the number of threads.
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


def scene_scale(extent: float, known: Sequence[KnownDepths]) -> float:
    """By what a training measures the means' steps and the sizes at which Gaussians split or go,
    world unit: the extent, but at most half of the median depth that is known.

    3DGS's measure is the extent, how far apart the cameras stand. Along a street that is many
    times the distance of anything they see, and steps that are measured by it go through walls.
    """
    depths = np.concatenate([view.z for view in known]) if known else np.zeros(0)
    return min(extent, SCALE_SHARE * float(np.median(depths))) if len(depths) else extent
