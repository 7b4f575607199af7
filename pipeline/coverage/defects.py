"""Defects in regions that few photographs see: holes and floaters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.coverage.probe_views import Bools, ProbeView, find_visible
from pipeline.coverage.trust import Observations
from pipeline.splats.gaussians import Gaussians

#: Number of photographs that must agree for a surface, or its absence, to be certain.
MIN_AGREEING = 2
#: Gaussians of less opacity are not counted as floaters.
MIN_OPACITY = 0.5
#: Floaters are searched up to this share of the distance of the nearest certain surfaces.
NEAR_SHARE = 0.5
#: Largest number of cameras that are named.
MAX_NAMED = 5


@dataclass(frozen=True)
class Floaters:
    """Opaque Gaussians in front of cameras, nearer than any certain surface.

    Attributes:
        count: The number of floaters.
        within: The search distance from a camera, world units; 0 if no surface is certain.
        cameras: The number of floaters that a camera shows, by name of the camera, largest first.
    """

    count: int
    within: float
    cameras: dict[str, int]


def holes(probe: ProbeView, observed: Observations, opaque: Bools | None) -> Bools:
    """(H, W) pixels whose ray meets no surface although one is there.

    Args:
        observed: The observations of the probe view's points.
        opaque: (H, W) opaque pixels of the photograph, if it has an alpha channel: these show a
            surface. Without (None), pixels are holes unless ``MIN_AGREEING`` photographs show
            background there as well.
    """
    few = (observed.count < MIN_AGREEING).reshape(probe.empty.shape)
    return probe.valid & probe.empty & (few if opaque is None else opaque)


def floating(probe: ProbeView, observed: Observations, nearest: float) -> Bools:
    """(H, W) pixels that show floaters: surface that fewer than ``MIN_AGREEING`` photographs see,
    and that as many see past or that is nearer than any certain surface.

    Args:
        observed: The observations of the probe view's points.
        nearest: The distance of the nearest certain surfaces, world units.
    """
    shape = probe.empty.shape
    few = (observed.count < MIN_AGREEING).reshape(shape)
    seen_past = observed.seen_past.reshape(shape) >= MIN_AGREEING
    return probe.valid & ~probe.empty & few & (seen_past | (probe.depth < NEAR_SHARE * nearest))


def near_floaters(
    gaussians: Gaussians, training: Sequence[ProbeView], test: Sequence[ProbeView], nearest: float
) -> Floaters:
    """Opaque Gaussians that a view shows nearer than any certain surface, and that fewer than
    ``MIN_AGREEING`` training views show.

    Args:
        nearest: The same as for ``floating``.
    """
    from scipy.spatial import cKDTree

    within = NEAR_SHARE * nearest
    probes = [*training, *test]
    logit = float(np.log(MIN_OPACITY / (1 - MIN_OPACITY)))
    tree = cKDTree(np.stack([probe.view.centre for probe in probes]))
    near = [np.zeros((0, 3))]
    for means, logits in gaussians.chunks("means", "opacity_logits"):
        opaque = means[logits >= logit].astype(np.float64)
        distance, _ = tree.query(opaque, distance_upper_bound=within)
        near.append(opaque[np.isfinite(distance)])
    xyz = np.concatenate(near)
    training_count, shown_by = np.zeros(len(xyz), int), np.full(len(xyz), -1)
    for i, probe in enumerate(probes):
        visible = find_visible(probe, xyz, np.zeros(len(xyz), bool)).visible
        training_count[visible] += i < len(training)
        close = np.linalg.norm(xyz[visible] - probe.view.centre, axis=1) <= within
        shown_by[visible[close]] = i
    floaters = (training_count < MIN_AGREEING) & (shown_by >= 0)
    counts = Counter(probes[i].view.name for i in shown_by[floaters])
    ranked = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return Floaters(counts.total(), within, dict(ranked[:MAX_NAMED]))
