"""The points of the fused cloud that Gaussians are initialised from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.mvs.maps import DenseCloud
from pipeline.photos.cloud import sampled
from pipeline.scene.reconstruction import Points
from pipeline.scene.views import View

# Points per voxel of the sample, before thinning.
OVERSAMPLING = 5
# Sparse points are added where no dense point is nearer than so many of its spacings: where depth
# maps have holes.
HOLE = 4.0
# Subsampling does not depend on the run's seed.
SEED = 0


@dataclass(frozen=True)
class SurfacePoints:
    """Points on surfaces.

    Attributes:
        normals: (P, 3) float64 unit normals in the world; NaN where unknown.
        num_sparse: number of sparse points among them, which are last.
    """

    points: Points
    normals: NDArray[np.float64]
    num_sparse: int


def surface_points(
    cloud: DenseCloud, sparse: Points, views: Sequence[View], max_points: int
) -> SurfacePoints:
    """At most ``max_points`` points of the cloud, one a voxel; voxels are smaller where views see
    more detail. Sparse points are added where the cloud has holes.

    Args:
        cloud: A cloud of at least two points.
    """
    chosen = np.arange(len(cloud))
    if len(chosen) > OVERSAMPLING * max_points:
        generator = np.random.Generator(np.random.PCG64(SEED))
        chosen = np.sort(generator.choice(len(cloud), OVERSAMPLING * max_points, replace=False))
    xyz = cloud.xyz[chosen].astype(np.float64)
    rows = sampled(xyz, views, max_points)
    xyz, chosen = xyz[rows], chosen[rows]
    added = _in_holes(sparse.xyz, xyz)
    normals = np.full((len(chosen) + len(added), 3), np.nan)
    normals[: len(chosen)] = cloud.normals[chosen]
    points = Points.without_tracks(
        np.concatenate([xyz, sparse.xyz[added]]),
        np.concatenate([cloud.rgb[chosen], sparse.rgb[added]]),
    )
    return SurfacePoints(points, normals, len(added))


def _in_holes(sparse: NDArray[np.float64], dense: NDArray[np.float64]) -> NDArray[np.intp]:
    """Indices of the sparse points that are far from all dense ones."""
    from scipy.spatial import cKDTree

    finite = np.flatnonzero(np.isfinite(sparse).all(1))
    if not len(finite) or len(dense) < 2:
        return finite
    tree = cKDTree(dense)
    distance, nearest = tree.query(sparse[finite])
    spacing = tree.query(dense[nearest], 2)[0][:, 1]
    return finite[distance > HOLE * np.maximum(spacing, 1e-12)]
