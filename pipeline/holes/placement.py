"""Where the holes of a view are, and Gaussians that fill them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.coverage.probe_views import (
    Bools,
    Doubles,
    Floats,
    ProbeView,
    backproject,
    find_visible,
    render_probe,
)
from pipeline.coverage.training_views import TrainingViews
from pipeline.holes.painters import pull_push
from pipeline.render import RasterOptions
from pipeline.render.views import render_view
from pipeline.scene.views import View
from pipeline.splats.arrays import GaussianArrays
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.init import isotropic

Picture = NDArray[np.uint8]

#: Longer side of a view that is painted, pixels.
PAINTED_SIDE = 512
#: Stride of the pixels whose visibility is computed, and of those that get a Gaussian.
SEEN_STEP, GAUSSIAN_STEP = 2, 2
#: Holes of fewer pixels are noise of the depth comparison.
MIN_HOLE_PX = 24
#: Standard deviation of a new Gaussian in strides, and its opacity.
SPREAD, OPACITY = 0.6, 0.95
#: The depths that are tried for a new Gaussian: the extrapolated depth times a power of this.
DEPTH_FACTOR, DEPTH_STEPS = 1.06, 20
#: What is in front of a hole seldom continues into it: a pixel counts by this power of its depth,
#: relative to this percentile of the depths.
FAR_POWER, FAR_PERCENTILE = 4.0, 75.0
#: The width in pixels of the edges of holes, where the background shines through surfaces.
EDGE_PX = 4
#: Surfaces that no photograph sees are smeared, or invented: they count by this factor.
UNSEEN_WEIGHT = 0.05
#: A surface farther than this many times the background depth of the training views is sky.
SKY_FACTOR = 3.0


@dataclass(frozen=True)
class HoleView:
    """A rendered view and its holes.

    Attributes:
        probe: The view, reduced to ``PAINTED_SIDE``, with its depth.
        hole: (H, W) True in pixels that show no surface although no training view sees that there
            is none.
        unseen: (H, W) True in pixels whose place no training view sees, holes and others.
    """

    probe: ProbeView
    hole: Bools
    unseen: Bools

    @property
    def share(self) -> float:
        """The share of the pixels that are holes."""
        return float(self.hole.mean())


def find_holes(
    view: View,
    gaussians: Gaussians,
    training: TrainingViews,
    options: RasterOptions,
    side: int = PAINTED_SIDE,
) -> HoleView:
    """Render a view and find its holes: pixels that show nothing, or a background of Gaussians far
    behind the scene, where no training view sees this. Surfaces that end where photographs end are
    no holes: training continues them.

    Args:
        side: The longer side of the rendered view, pixels.
    """
    probe = render_probe(view, lambda small: render_view(gaussians, small, options), side)
    points = backproject(probe, training.background_depth, SEEN_STEP)
    unseen = np.ones(len(points), bool)
    for photograph in training.probes:
        unseen[find_visible(photograph, points.xyz, points.empty).visible] = False
    height, width = probe.depth.shape
    rows, columns = (np.arange(SEEN_STEP // 2, size, SEEN_STEP) for size in (height, width))
    grid = unseen.reshape(len(rows), len(columns)).astype(np.uint8)
    whole = cv2.resize(grid, (width, height), interpolation=cv2.INTER_NEAREST) > 0
    beyond = probe.depth > SKY_FACTOR * training.background_depth
    return HoleView(probe, _without_specks(whole & beyond), whole)


def _without_specks(hole: Bools) -> Bools:
    """(H, W) the connected holes of at least ``MIN_HOLE_PX`` pixels, without thin lines."""
    opened = cv2.morphologyEx(hole.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= MIN_HOLE_PX
    large[0] = False
    return np.asarray(large[labels])


def context_weights(found: HoleView, background_depth: float) -> Doubles:
    """(H, W) how much each pixel counts where colours and depths are continued into the holes: 0 to
    1, more for far surfaces, and for what photographs see; 0 in holes and at their edges, and for
    sky where there is any surface."""
    depth = found.probe.depth.astype(np.float64)
    square = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    edge = cv2.dilate(found.hole.astype(np.uint8), square) > 0
    surface = ~edge & (depth < SKY_FACTOR * background_depth)
    if not surface.any():
        return np.where(found.hole, 0.0, 1.0)
    far = float(np.percentile(depth[surface], FAR_PERCENTILE))
    shares = np.minimum(np.where(surface, depth, 0.0) / far, 1.0)
    return np.asarray(shares**FAR_POWER * np.where(found.unseen, UNSEEN_WEIGHT, 1.0))


def hole_depths(found: HoleView, background_depth: float) -> Floats:
    """(H, W) depth with that of the holes continued from around them, camera z, world units.

    Disparities, which are linear on planes, are averaged.
    """
    depth = found.probe.depth.astype(np.float64)
    usable = np.where(np.isfinite(depth) & (depth < SKY_FACTOR * background_depth), depth, np.inf)
    weights = np.where(np.isfinite(usable), context_weights(found, background_depth), 0.0)
    if not weights.any():
        return np.full(depth.shape, background_depth, np.float32)
    filled = pull_push((1 / usable)[..., None], weights)[..., 0]
    return np.where(found.hole, 1 / filled, depth).astype(np.float32)


def place_gaussians(
    found: HoleView, painted: Picture, training: TrainingViews, sh_degree: int
) -> GaussianArrays | None:
    """Gaussians in the colours of the painted image, at the extrapolated depths of its holes; None
    if there is no place for any.

    A Gaussian is moved away from the camera until no training view sees the place, and left out if
    it would have to be moved too far.

    Args:
        painted: (H, W, 3) RGB.
    """
    depth = hole_depths(found, training.background_depth)
    probe = replace(found.probe, depth=depth)
    points = backproject(probe, training.background_depth, GAUSSIAN_STEP)
    sampled = slice(GAUSSIAN_STEP // 2, None, GAUSSIAN_STEP)
    chosen = np.flatnonzero(found.hole[sampled, sampled].ravel())
    colours = painted[sampled, sampled].reshape(-1, 3)[chosen] / 255.0
    z = depth[sampled, sampled].ravel()[chosen].astype(np.float64)
    centre = found.probe.view.centre
    xyz, factor = _unseen_places(centre, points.xyz[chosen], training.probes)
    kept = np.isfinite(factor)
    if not kept.any():
        return None
    view = found.probe.view
    focal = float(np.sqrt(view.fx * view.fy))
    scale = SPREAD * GAUSSIAN_STEP * z[kept] * factor[kept] / focal
    return isotropic(xyz[kept], scale, colours[kept], OPACITY, sh_degree)


def _unseen_places(
    centre: Doubles, xyz: Doubles, probes: Sequence[ProbeView]
) -> tuple[Doubles, Doubles]:
    """Move points (N, 3) away from a camera, each to the first depth at which no training view sees
    it or sees past it.

    Returns:
        (N, 3) the places, and (N,) the factors of the depths; inf without such a place.
    """
    ray, factors = xyz - centre, np.full(len(xyz), np.inf)
    for step in range(DEPTH_STEPS):
        factor = DEPTH_FACTOR**step
        open_ = np.flatnonzero(~np.isfinite(factors))
        tried = centre + factor * ray[open_]
        hidden = np.ones(len(open_), bool)
        for probe in probes:
            seen = find_visible(probe, tried, np.zeros(len(tried), bool))
            hidden[seen.visible] = False
            hidden &= ~seen.seen_past
        factors[open_[hidden]] = factor
    placed: Any = np.where(np.isfinite(factors), factors, 1)[:, None]
    return centre + placed * ray, factors
