"""The first Gaussians, from sparse points or from nothing but the cameras.

After Kerbl et al. 2023, section 5.1: a sphere at each point, as wide as the mean distance of its
three nearest neighbours. Needs numpy and scipy, not torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from pipeline.config.experiments import DEFAULT, InitExperiments
from pipeline.config.schema import Init
from pipeline.geometry.rotations import rotation_to_quat
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import Points
from pipeline.scene.views import View, scene_extent

# The constant spherical harmonic, 1 / (2 sqrt(pi)): colour = 0.5 + SH_C0 * coefficient.
SH_C0 = 0.28209479177387814

NEIGHBOURS = 3
# As many with the point itself tell which way the surface there lies.
PATCH = 12
# A first Gaussian's standard deviation as seen from the nearest camera, radians: from a tenth of
# a pixel (at a focal length of 1000) up to half a view. Less leaves bare walls, where points are
# few, black for long; more is a stray point's haze over everything.
MIN_ANGLE, MAX_ANGLE = 1e-4, 0.5
LONE_ANGLE = 0.1  # of a single Gaussian
# Points nearer to a camera than this share of the usual distance are SfM errors (a point at a
# camera's centre is a known one); points farther than this many usual distances, too.
TOO_NEAR, TOO_FAR = 0.01, 100.0
# Of a random start: the cube's side in extents of the scene (a ball alone leaves bonsai's walls to
# what floats before its cameras: 15.6 dB instead of 23.5; sides of 12 and 24 gave 23.2 and 22.2),
# and the most opaque it may be (at 0.3 it hides what is behind: 17.9 dB instead of 20.5).
CUBE, RANDOM_OPACITY = 6.0, 0.1
# Depths ahead of cameras that look the same way, in extents. What starts nearer stays before one
# camera as fog (lund_door: 10.9 dB from 0.3 on, 21.6 from 1, 22.6 from 3).
AHEAD = 1.0, 30.0
# Thinning is part of the data's preparation, not of the run's randomness.
THINNING_SEED = 0


@dataclass
class InitGaussians:
    """Structure of arrays, float32: see ``pipeline.splats.gaussians.Gaussians``.

    Attributes:
        means, log_scales: (N, 3); quats: (N, 4) wxyz; opacity_logits: (N,); sh: (N, K, 3).
        num_dropped: points left out because they were not finite, too near or too far.
        num_thinned: points left out because there were more than ``Init.max_points``.
    """

    means: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    quats: NDArray[np.float32]
    opacity_logits: NDArray[np.float32]
    sh: NDArray[np.float32]
    num_dropped: int = 0
    num_thinned: int = 0

    def __len__(self) -> int:
        return len(self.means)

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """The five arrays by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)[:5]}


def gaussians_from_points(
    points: Points,
    camera_centres: NDArray[np.float64],
    config: Init,
    sh_degree: int,
    experiments: InitExperiments = DEFAULT.init,
) -> InitGaussians:
    """A Gaussian at each sparse point.

    Args:
        camera_centres: (C, 3) float64, world.

    Raises:
        UserError: no point is left.
    """
    from scipy.spatial import cKDTree

    # float32's range with room for squares; beyond lies no scene.
    usable = np.isfinite(points.xyz).all(1) & (np.abs(points.xyz) < 1e18).all(1)
    kept = np.flatnonzero(usable)
    distance = _nearest_distance(points.xyz[kept], camera_centres)
    usual = float(np.median(distance)) if len(kept) else 0.0
    inside = (distance >= TOO_NEAR * usual) & (distance <= TOO_FAR * usual)
    kept, distance = kept[inside], distance[inside]
    num_dropped = len(points) - len(kept)
    if not len(kept):
        raise UserError(
            f"expected sparse points to start the Gaussians from; of {len(points)} none is usable",
            fix="set init.method: random, or check the reconstruction",
        )
    num_thinned = max(0, len(kept) - config.max_points)
    if num_thinned:
        generator = np.random.Generator(np.random.PCG64(THINNING_SEED))
        chosen = np.sort(generator.choice(len(kept), config.max_points, replace=False))
        kept, distance = kept[chosen], distance[chosen]

    xyz = points.xyz[kept]
    found, near = cKDTree(xyz).query(xyz, min(PATCH, len(xyz)))
    spacing = (
        found[:, 1 : NEIGHBOURS + 1].mean(1) if len(xyz) > 1 else np.full(1, LONE_ANGLE * usual)
    )
    colour = points.rgb[kept].astype(np.float64) / 255.0
    result = _spheres(xyz, _clamp(spacing, distance), colour, experiments.opacity, sh_degree)
    if len(xyz) > NEIGHBOURS:
        result.quats[:] = _lying(xyz, near)
    result.num_dropped, result.num_thinned = num_dropped, num_thinned
    return result


def gaussians_random(
    views: Sequence[View], sh_degree: int, seed: int, experiments: InitExperiments = DEFAULT.init
) -> InitGaussians:
    """``experiments.num_random`` Gaussians of random colour in the volume the cameras look at.

    Where the cameras look at one place: half of them in a ball around it that all of them see
    whole, half in a cube around the cameras, for what stands behind. Otherwise (cameras looking
    ahead, or outward): random depths along the rays of random pixels.
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
        side = CUBE * scene_extent(list(views))
        cube = centres.mean(0) + side * (generator.random((count, 3)) - 0.5)
        xyz[1::2] = cube[1::2]
    else:
        xyz = _in_frustums(views, scene_extent(list(views)), count, generator)
    distance = _nearest_distance(xyz, centres)
    k = min(NEIGHBOURS, count - 1)
    spacing = cKDTree(xyz).query(xyz, k + 1)[0][:, 1:].mean(1) if k else LONE_ANGLE * distance
    colour = generator.random((count, 3))
    opacity = min(experiments.opacity, RANDOM_OPACITY)
    return _spheres(xyz, _clamp(spacing, distance), colour, opacity, sh_degree)


def _common_ball(
    views: Sequence[View], centres: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float] | None:
    """(centre (3,), radius) of what the cameras look at together, None if nothing."""
    axes = np.stack([view.world_to_camera[2, :3] for view in views])
    # The point nearest to all optical axes: sum (I - a a^T) (x - c) = 0.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(0)
    # Axes nearly parallel: their nearest point says nothing.
    if len(views) < 2 or np.linalg.eigvalsh(normal)[0] < 0.02 * len(views):
        return None
    target = np.linalg.solve(normal, (across @ centres[:, :, None]).sum(0))[:, 0]
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
    """(count, 3) points at log-uniform depths, ``AHEAD`` times the scene's extent."""
    chosen = generator.integers(len(views), size=count)
    uv = generator.random((count, 2))
    near, far = np.log(AHEAD)
    depth = extent * np.exp(generator.uniform(near, far, count))
    intrinsics = np.array([(v.width, v.height, v.fx, v.fy, v.cx, v.cy) for v in views])[chosen]
    width, height, fx, fy, cx, cy = intrinsics.T
    ray = np.stack([(uv[:, 0] * width - cx) / fx, (uv[:, 1] * height - cy) / fy, np.ones(count)], 1)
    rotation = np.stack([v.world_to_camera[:3, :3] for v in views])[chosen]
    centres = np.stack([v.centre for v in views])[chosen]
    return centres + np.einsum("nij,ni->nj", rotation, ray * depth[:, None])


def _nearest_distance(
    xyz: NDArray[np.float64], centres: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(P,) distance of each point to the nearest camera."""
    from scipy.spatial import cKDTree

    if not len(xyz):
        return np.zeros(0)
    return np.asarray(cKDTree(centres).query(xyz)[0], np.float64)


def _lying(xyz: NDArray[np.float64], near: NDArray[np.intp]) -> NDArray[np.float64]:
    """(N, 4) wxyz, turned so that the first axis stands on the surface through each point's
    neighbours (N, k): a sphere that becomes a disc need only shrink."""
    patch = xyz[near] - xyz[near].mean(1, keepdims=True)
    axes = np.linalg.eigh(np.einsum("nki,nkj->nij", patch, patch))[1]
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    return rotation_to_quat(axes)


def _clamp(spacing: NDArray[np.float64], distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scales that are neither nothing (duplicate points) nor all of the view (lone points)."""
    scale = np.clip(spacing, MIN_ANGLE * distance, MAX_ANGLE * distance)
    return np.maximum(scale, 1e-12)


def _spheres(
    xyz: NDArray[np.float64],
    scale: NDArray[np.float64],
    colour: NDArray[np.float64],
    opacity: float,
    sh_degree: int,
) -> InitGaussians:
    """Spheres of standard deviation ``scale`` (N,) and linear colour (N, 3) in [0, 1]."""
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
