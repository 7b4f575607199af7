"""Gaussians on a sphere around the scene, behind all others (a skybox, as in Kerbl et al. 2024,
"A Hierarchical 3D Gaussian Representation for Real-Time Rendering of Very Large Datasets").

They become the sky. Behind them is the same again, the fill, which training leaves as it is: the
colour of the nearest points instead of a hole where no photograph looks, or where training shrinks
the sky at the edges of photographs. Scenes without sky have only the fill, since a skybox would
become surfaces at a wrong depth. Uses numpy and scipy, not torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.splats.arrays import NAMES
from pipeline.splats.init import (
    FLATNESS,
    SH_C0,
    InitGaussians,
    isotropic,
    nearest_distance,
    rotations_to,
)

# The backgrounds that are a skybox.
SKYBOXES = ("skybox", "fill")
# Number of Gaussians: one every 9 degrees, which density control splits where sky has detail.
NUM_GAUSSIANS = 500
# The radius is RADIUS times this quantile of the depths of the points.
RADIUS, DEPTH_QUANTILE = 10.0, 0.95
# Lower bound of the depth: cameras and points can be in one place.
MIN_DEPTH = 1e-12
# The sky is this many times as far from the cameras as half of the scene.
SKY_DISTANCE = 5.0
# Standard deviation, in distances of neighbours. Smaller ones leave gaps.
SPREAD = 0.7
# The skybox must hide the background from the first step on.
OPACITY = 0.95
# The fill is farther away by this factor. It is recognised by its opacity, which other Gaussians do
# not start with.
FILL_RADIUS, FILL_OPACITY = 2.0, 0.951
# The colour of a Gaussian is a mean over this many points, the nearest in direction.
NUM_POINTS = 16


def with_skybox(
    gaussians: InitGaussians, camera_centres: NDArray[np.float64], *, trained: bool = True
) -> InitGaussians:
    """The Gaussians, followed by those of a skybox, flat along the rays from its centre.

    Args:
        camera_centres: (C, 3) float64 in world coordinates.
        trained: Whether there is a skybox to train before the fill.
    """
    xyz = gaussians.means.astype(np.float64)
    centre = camera_centres.mean(0)
    depth = np.quantile(nearest_distance(xyz, camera_centres), DEPTH_QUANTILE)
    outermost = np.linalg.norm(camera_centres - centre, axis=1).max()
    radius = RADIUS * max(depth, outermost, MIN_DEPTH)
    directions = fibonacci_sphere(NUM_GAUSSIANS)
    colours = np.clip(0.5 + SH_C0 * gaussians.sh[:, 0].astype(np.float64), 0, 1)
    seen = colours_towards(directions, centre, xyz, colours)
    parts = [gaussians.arrays()]
    for far, opacity in ((1.0, OPACITY), (FILL_RADIUS, FILL_OPACITY))[not trained :]:
        scale = np.full(NUM_GAUSSIANS, SPREAD * far * radius * np.sqrt(4 * np.pi / NUM_GAUSSIANS))
        sky = isotropic(
            centre + far * radius * directions, scale, seen, opacity, gaussians.sh_degree
        )
        sky.quats[:] = rotations_to(directions)
        sky.log_scales[:, 0] += np.float32(np.log(FLATNESS))
        parts.append(sky.arrays())
    both = {name: np.concatenate([part[name] for part in parts]) for name in NAMES}
    return InitGaussians(
        **both, num_dropped=gaussians.num_dropped, num_thinned=gaussians.num_thinned
    )


@dataclass(frozen=True)
class Sky:
    """What is much farther from the cameras than the scene: the skybox, also after training has
    moved and split it.

    Attributes:
        camera_centres: (C, 3) float64 in world coordinates.
    """

    camera_centres: NDArray[np.float64]

    def contains(
        self, means: NDArray[Any], weights: NDArray[np.float64] | None = None
    ) -> NDArray[np.bool_]:
        """(N,) whether Gaussians at these means (N, 3) are sky: over ``SKY_DISTANCE`` times as far
        away as half of all, by number or by ``weights`` (N,)."""
        if not len(means):
            return np.zeros(0, bool)
        finite = np.isfinite(means).all(1)
        distance = np.zeros(len(means))
        distance[finite] = nearest_distance(means[finite].astype(np.float64), self.camera_centres)
        order = np.argsort(distance, kind="stable")
        total = np.cumsum(np.ones(len(order)) if weights is None else weights[order])
        middle = distance[order[np.searchsorted(total, 0.5 * total[-1])]]
        return np.asarray(distance > SKY_DISTANCE * middle)


def of_fill(opacity_logits: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(N,) whether Gaussians are of the fill, by their opacity."""
    return np.asarray(opacity_logits == np.float32(np.log(FILL_OPACITY / (1 - FILL_OPACITY))))


def fibonacci_sphere(count: int) -> NDArray[np.float64]:
    """(count, 3) unit vectors, evenly distributed: equal steps along an axis, turned by the golden
    angle (González 2010, "Measurement of areas on a sphere using Fibonacci and latitude-longitude
    lattices")."""
    steps = np.arange(count) + 0.5
    z = 1 - 2 * steps / count
    angle = np.pi * (1 + 5**0.5) * steps
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], 1)


def colours_towards(
    directions: NDArray[np.float64],
    centre: NDArray[np.float64],
    xyz: NDArray[np.float64],
    colours: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(D, 3) colour of the points (P, 3) nearest to each direction (D, 3), as seen from ``centre``.

    Nearer ones count more, by a Gaussian of which the farthest is two standard deviations away.
    """
    from scipy.spatial import cKDTree

    rays = xyz - centre
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), np.finfo(float).tiny)
    count = min(NUM_POINTS, len(rays))
    distances, nearest = cKDTree(rays).query(directions, [*range(1, count + 1)])
    farthest = np.maximum(distances[:, -1:], np.finfo(float).tiny)
    weights = np.exp(-0.5 * (2 * distances / farthest) ** 2)[:, :, None]
    return (weights * colours[nearest]).sum(1) / weights.sum(1)
