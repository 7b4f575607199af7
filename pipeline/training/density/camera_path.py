"""Gaussians on the path of the cameras, which hide a view from between two photographs.

The space around the straight path between neighbouring cameras is empty, but no photograph
contradicts a Gaussian there that is outside of their images, or a few pixels of some. Seen from the
path, it covers most of the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render.contributions import contributions, in_grey
from pipeline.splats.gaussians import Gaussians
from pipeline.training.density.reduced_views import ReducedViews

#: The path joins each camera to so many of its nearest.
NEIGHBOURS = 4
#: Longest segment, over the depth up to which its cameras see empty space. A longer one can have a
#: wall between them. Cameras that fly over streets are farther apart than the nearest points.
MAX_LENGTH = 3.0
#: Space is empty up to this share of the depth up to which both views see empty space.
REACH_SHARE = 0.5
#: Smallest scale of a Gaussian that is removed, over its distance to the path: with a usual lens,
#: it covers most of the image from there.
MIN_SIZE = 0.3
#: A Gaussian that explains a larger share of the pixels of a training view, divided by its opacity,
#: stays.
MAX_VIEW_SHARE = 0.01
#: More transparent Gaussians hide nothing.
MIN_OPACITY = 0.02


class Segment(NamedTuple):
    """A straight part of the path, and the distance up to which the space around it is empty."""

    start: NDArray[np.float64]
    end: NDArray[np.float64]
    reach: float


def camera_path(centres: NDArray[np.float64], depths: NDArray[np.float64]) -> list[Segment]:
    """The segments between neighbouring cameras, up to ``MAX_LENGTH``.

    Args:
        centres: (V, 3) camera centres, world.
        depths: (V,) z up to which each view sees empty space (``floaters.empty_depths``).
    """
    from scipy.spatial import KDTree  # Not above: it takes memory during training.

    count = min(NEIGHBOURS + 1, len(centres))
    distances, neighbours = KDTree(centres).query(centres, [*range(1, count + 1)])
    segments = {}
    for first, (row, others) in enumerate(zip(distances, neighbours, strict=True)):
        for distance, second in zip(row, others, strict=True):
            empty = min(depths[first], depths[second])
            if second != first and distance < MAX_LENGTH * empty:
                pair = min(first, second), max(first, second)
                segments[pair] = Segment(centres[pair[0]], centres[pair[1]], REACH_SHARE * empty)
    return [segments[pair] for pair in sorted(segments)]


def distances_to_path(
    points: NDArray[np.float64], segments: Sequence[Segment]
) -> NDArray[np.float64]:
    """(N,) distance of each point to the path, infinite where no segment reaches it."""
    from scipy.spatial import KDTree

    nearest = np.full(len(points), np.inf)
    finite = np.flatnonzero(np.isfinite(points).all(1))
    if not segments or not len(finite):
        return nearest
    tree = KDTree(points[finite])
    for start, end, reach in segments:
        along = end - start
        length = np.linalg.norm(along)
        ball = tree.query_ball_point((start + end) / 2, length / 2 + reach)
        near = finite[np.array(ball, dtype=np.intp)]
        t = ((points[near] - start) @ along) / max(length**2, np.finfo(float).tiny)
        on_path = start + np.clip(t, 0.0, 1.0)[:, None] * along
        distance = np.linalg.norm(points[near] - on_path, axis=1)
        near, distance = near[distance < reach], distance[distance < reach]
        nearest[near] = np.minimum(nearest[near], distance)
    return nearest


def on_camera_path(
    gaussians: Gaussians, views: ReducedViews, depths: NDArray[np.float64]
) -> Tensor:
    """(N,) bool: Gaussians that would hide a view from the path, and explain little of any training
    view.

    Args:
        views: All training views.
        depths: (V,) camera z (``floaters.empty_depths``).
    """
    found = torch.zeros(len(gaussians), dtype=torch.bool)
    matrices = np.stack([camera.world_to_camera.double().numpy() for camera in views.cameras])
    centres = -np.einsum("vji,vj->vi", matrices[:, :3, :3], matrices[:, :3, 3])
    distance = distances_to_path(gaussians.means.double().numpy(), camera_path(centres, depths))
    size = gaussians.log_scales.amax(1).double().exp().numpy()
    opacity = torch.sigmoid(gaussians.opacity_logits)
    large = torch.from_numpy(size > MIN_SIZE * distance) & (opacity > MIN_OPACITY)
    candidates = torch.nonzero(large)[:, 0]
    if not len(candidates):
        return found
    # Rendered without the Gaussians in front of them, so that the share is an upper bound.
    grey, share = in_grey(gaussians.select(candidates)), torch.zeros(len(candidates))
    for camera in views.cameras:
        pixel = 1 / (camera.width * camera.height)
        seen = contributions(grey, camera, views.options, pixel, views.backend)
        share = torch.maximum(share, seen)
    found[candidates] = share < MAX_VIEW_SHARE * opacity[candidates]
    return found
