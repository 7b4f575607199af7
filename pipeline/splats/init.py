"""Initialisation of Gaussians from sparse points, or at random from the cameras alone.

From points as in Kerbl et al. 2023, section 5.1: an isotropic Gaussian at each point, whose scale
is the mean distance to its three nearest neighbours. Uses numpy and scipy, not torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.config.experiments import DEFAULT, InitExperiments
from pipeline.config.settled import Init
from pipeline.geometry.rotations import rotation_to_quat
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import Points
from pipeline.scene.views import View, scene_extent
from pipeline.splats.arrays import GaussianArrays

# The constant spherical harmonic, 1 / (2 sqrt(pi)): colour = 0.5 + SH_C0 * coefficient.
SH_C0 = 0.28209479177387814

# Number of neighbours that determine the scale.
NEIGHBOURS = 3
# Number of neighbours, with the point itself, that determine the surface normal.
NORMAL_NEIGHBOURS = 12
# Thickness of Gaussians with a known normal, relative to their other axes.
FLATNESS = 0.3
# Axes of Gaussians point into the half space of this direction. No plane that contains simple
# directions is orthogonal to it.
SIGN_DIRECTION = np.array([1.0, 0.7548, 0.5698])
# Range of the standard deviation as seen from the nearest camera, radians: from a tenth of a pixel
# (at a focal length of 1000) to half a view. A lower maximum leaves holes between sparse points; a
# higher one lets outliers cover the scene.
MIN_ANGLE, MAX_ANGLE = 1e-4, 0.5
# Standard deviation of a Gaussian without neighbours, as seen from the nearest camera, radians.
LONE_ANGLE = 0.1
# Range of the distance to the nearest camera, relative to the median: points outside are SfM
# errors, such as points at a camera's centre.
TOO_NEAR, TOO_FAR = 0.01, 100.0
# Random initialisation: side of the cube in scene extents, and maximum opacity. Without the cube
# the background is reconstructed by floaters near the cameras; opaque Gaussians hide the others.
CUBE_SIDE, RANDOM_OPACITY = 6.0, 0.1
# Random initialisation in frustums: range of depth in scene extents. Gaussians closer to a camera
# become floaters.
DEPTH_RANGE = 1.0, 30.0
# Subsampling does not depend on the run's seed.
THINNING_SEED = 0


@dataclass
class InitGaussians(GaussianArrays):
    """Initial Gaussians.

    Attributes:
        num_dropped: The number of points left out because they are not finite, too near or too far.
        num_thinned: The number of points left out because there are more than ``Init.max_points``.
    """

    num_dropped: int = 0
    num_thinned: int = 0


def gaussians_from_points(
    points: Points,
    camera_centres: NDArray[np.float64],
    config: Init,
    sh_degree: int,
    experiments: InitExperiments = DEFAULT.init,
    normals: NDArray[np.float64] | None = None,
) -> InitGaussians:
    """Initialise one Gaussian at each point.

    The first axis of each Gaussian is the normal of the surface: with known normals, Gaussians are
    flat along it; otherwise it is that of the surface through the neighbours.

    Args:
        camera_centres: (C, 3) float64 in world coordinates.
        normals: (P, 3) unit normals in the world, NaN where unknown; None if all are.

    Raises:
        UserError: No point is usable.
    """
    from scipy.spatial import cKDTree

    # The squares of larger coordinates overflow float32.
    usable = np.isfinite(points.xyz).all(1) & (np.abs(points.xyz) < 1e18).all(1)
    chosen = np.flatnonzero(usable)
    distance = nearest_distance(points.xyz[chosen], camera_centres)
    median = float(np.median(distance)) if len(chosen) else 0.0
    inside = (distance >= TOO_NEAR * median) & (distance <= TOO_FAR * median)
    chosen, distance = chosen[inside], distance[inside]
    num_dropped = len(points) - len(chosen)
    if not len(chosen):
        raise UserError(
            f"expected sparse points to initialise Gaussians; of {len(points)} none is usable",
            fix="set init.method: random, or check the reconstruction",
        )
    num_thinned = max(0, len(chosen) - config.max_points)
    if num_thinned:
        generator = np.random.Generator(np.random.PCG64(THINNING_SEED))
        subset = np.sort(generator.choice(len(chosen), config.max_points, replace=False))
        chosen, distance = chosen[subset], distance[subset]

    xyz = points.xyz[chosen]
    distances, neighbours = cKDTree(xyz).query(xyz, min(NORMAL_NEIGHBOURS, len(xyz)))
    spacing = (
        distances[:, 1 : NEIGHBOURS + 1].mean(1)
        if len(xyz) > 1
        else np.full(1, LONE_ANGLE * median)
    )
    colour = points.rgb[chosen].astype(np.float64) / 255.0
    result = isotropic(xyz, _clamp(spacing, distance), colour, experiments.opacity, sh_degree)
    if len(xyz) > NEIGHBOURS:
        result.quats[:] = _normal_rotations(xyz, neighbours)
    if normals is not None:
        known = np.isfinite(normals[chosen]).all(1)
        result.quats[known] = rotations_to(normals[chosen[known]])
        result.log_scales[known, 0] += np.float32(np.log(FLATNESS))
    result.num_dropped, result.num_thinned = num_dropped, num_thinned
    return result


def gaussians_random(
    views: Sequence[View], sh_degree: int, seed: int, experiments: InitExperiments = DEFAULT.init
) -> InitGaussians:
    """Initialise ``experiments.num_random`` Gaussians of random colour in the volume that the
    cameras see.

    If the cameras face a common point, half of the Gaussians are in a ball around it that is inside
    all views, and half in a cube around the cameras, for the background. Otherwise (forward-facing
    or outward-facing cameras), Gaussians are at random depths along the rays of random pixels.
    """
    from scipy.spatial import cKDTree

    generator = np.random.Generator(np.random.PCG64(seed))
    centres = np.stack([view.centre for view in views])
    count = experiments.num_random
    ball = _common_ball(views, centres)
    if ball is not None:
        centre, radius = ball
        direction = generator.normal(size=(count, 3))
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
        xyz = centre + radius * np.cbrt(generator.random((count, 1))) * direction
        side = CUBE_SIDE * scene_extent(list(views))
        cube = centres.mean(0) + side * (generator.random((count, 3)) - 0.5)
        xyz[1::2] = cube[1::2]
    else:
        xyz = _in_frustums(views, scene_extent(list(views)), count, generator)
    distance = nearest_distance(xyz, centres)
    k = min(NEIGHBOURS, count - 1)
    spacing = cKDTree(xyz).query(xyz, k + 1)[0][:, 1:].mean(1) if k else LONE_ANGLE * distance
    colour = generator.random((count, 3))
    opacity = min(experiments.opacity, RANDOM_OPACITY)
    return isotropic(xyz, _clamp(spacing, distance), colour, opacity, sh_degree)


def _common_ball(
    views: Sequence[View], centres: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float] | None:
    """Centre (3,) and radius of the ball that the cameras face, None if they face no common
    point."""
    axes = np.stack([view.world_to_camera[2, :3] for view in views])
    # The point closest to all optical axes: sum (I - a a^T) (x - c) = 0.
    projections = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    matrix = projections.sum(0)
    # Nearly parallel axes do not determine the point.
    if len(views) < 2 or np.linalg.eigvalsh(matrix)[0] < 0.02 * len(views):
        return None
    target = np.linalg.solve(matrix, (projections @ centres[:, :, None]).sum(0))[:, 0]
    depth = ((target - centres) * axes).sum(1)
    if np.mean(depth > 0) < 0.9:
        return None
    half_angle = np.array(
        [np.arctan(min(view.width / view.fx, view.height / view.fy) / 2) for view in views]
    )
    radius = float(np.median(np.linalg.norm(target - centres, axis=1) * np.sin(half_angle)))
    return (target, radius) if radius > 0 else None


def _in_frustums(
    views: Sequence[View], extent: float, count: int, generator: np.random.Generator
) -> NDArray[np.float64]:
    """(count, 3) points in the views' frustums at log-uniform depths of ``DEPTH_RANGE``."""
    chosen = generator.integers(len(views), size=count)
    uv = generator.random((count, 2))
    near, far = np.log(DEPTH_RANGE)
    depth = extent * np.exp(generator.uniform(near, far, count))
    intrinsics = np.array([(v.width, v.height, v.fx, v.fy, v.cx, v.cy) for v in views])[chosen]
    width, height, fx, fy, cx, cy = intrinsics.T
    ray = np.stack([(uv[:, 0] * width - cx) / fx, (uv[:, 1] * height - cy) / fy, np.ones(count)], 1)
    rotation = np.stack([v.world_to_camera[:3, :3] for v in views])[chosen]
    centres = np.stack([v.centre for v in views])[chosen]
    return centres + np.einsum("nij,ni->nj", rotation, ray * depth[:, None])


def nearest_distance(xyz: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P,) distance of each point to the nearest camera."""
    from scipy.spatial import cKDTree

    if not len(xyz):
        return np.zeros(0)
    return np.asarray(cKDTree(centres).query(xyz)[0], np.float64)


def _normal_rotations(
    xyz: NDArray[np.float64], neighbours: NDArray[np.intp]
) -> NDArray[np.float64]:
    """(N, 4) quaternions (wxyz) whose first axis is the normal of the surface through each point's
    neighbours (N, k), so that a Gaussian on a surface flattens along an axis."""
    centred = xyz[neighbours] - xyz[neighbours].mean(1, keepdims=True)
    axes = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1]
    # An eigenvector's sign is arbitrary, and rounding would decide it.
    axes *= np.where(np.einsum("nij,i->nj", axes, SIGN_DIRECTION) < 0, -1.0, 1.0)[:, None, :]
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    return rotation_to_quat(axes)


def rotations_to(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4) quaternions (wxyz) whose first axis is the normal (N, 3).

    The other axes are orthonormal (Duff et al. 2017, "Building an Orthonormal Basis, Revisited").
    """
    x, y, z = normals.T
    sign = np.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    second = np.column_stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    third = np.column_stack([b, sign + y * y * a, -y])
    return rotation_to_quat(np.stack([normals, second, third], axis=2))


def _clamp(spacing: NDArray[np.float64], distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scales clamped to ``MIN_ANGLE`` (duplicate points) and ``MAX_ANGLE`` (isolated points)."""
    scale = np.clip(spacing, MIN_ANGLE * distance, MAX_ANGLE * distance)
    return np.maximum(scale, 1e-12)


def isotropic(
    xyz: NDArray[np.float64],
    scale: NDArray[np.float64],
    colour: NDArray[np.float64],
    opacity: float,
    sh_degree: int,
) -> InitGaussians:
    """Isotropic Gaussians of standard deviation ``scale`` (N,) and colour (N, 3) in [0, 1]."""
    n = len(xyz)
    sh = np.zeros((n, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (colour - 0.5) / SH_C0
    quats = np.zeros((n, 4), np.float32)
    quats[:, 0] = 1.0
    p = min(max(opacity, 1e-4), 1 - 1e-4)
    return InitGaussians(
        means=np.ascontiguousarray(xyz, np.float32),
        log_scales=np.repeat(np.log(scale)[:, None], 3, 1).astype(np.float32),
        quats=quats,
        opacity_logits=np.full(n, np.log(p / (1 - p)), np.float32),
        sh=sh,
    )
