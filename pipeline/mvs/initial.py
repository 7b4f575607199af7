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
# Subsampling does not depend on the run's seed.
SEED = 0


@dataclass(frozen=True)
class SurfacePoints:
    """Points on surfaces.

    Attributes:
        normals: (P, 3) float64 unit normals in the world.
    """

    points: Points
    normals: NDArray[np.float64]


def surface_points(cloud: DenseCloud, views: Sequence[View], max_points: int) -> SurfacePoints:
    """At most ``max_points`` points of the cloud, one a voxel; voxels are smaller where views see
    more detail."""
    chosen = np.arange(len(cloud))
    if len(chosen) > OVERSAMPLING * max_points:
        generator = np.random.Generator(np.random.PCG64(SEED))
        chosen = np.sort(generator.choice(len(cloud), OVERSAMPLING * max_points, replace=False))
    xyz = cloud.xyz[chosen].astype(np.float64)
    rows = sampled(xyz, views, max_points)
    chosen = chosen[rows]
    points = Points.without_tracks(xyz[rows], cloud.rgb[chosen])
    return SurfacePoints(points, cloud.normals[chosen].astype(np.float64))
