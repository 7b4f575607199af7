"""What is wrong where few photographs look: rays without a surface, and floaters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.coverage.sight import Bools, Eye, look_for
from pipeline.coverage.trust import Evidence
from pipeline.splats.gaussians import Gaussians

#: Photographs that must agree on anything; fewer are few.
AGREE = 2
#: Gaussians less opaque are not counted as floaters.
MIN_OPACITY = 0.5
#: Floaters are sought up to this share of the distance of the nearest surfaces.
NEAR_SHARE = 0.5
#: Cameras named that have most of them.
NAMED = 5


@dataclass(frozen=True)
class Floaters:
    """Opaque Gaussians close to cameras that stand in no surface.

    Attributes:
        count: how many.
        within: distance from a camera up to which they were sought, world unit; 0 where no surface
            is agreed on.
        cameras: names of the nearest cameras, those with most first, with their number.
    """

    count: int
    within: float
    cameras: dict[str, int]


def holes(eye: Eye, evidence: Evidence, opaque: Bools | None) -> Bools:
    """(H, W) pixels whose rays meet no surface, though there is one, or though none of the
    photographs says that there is none.

    Args:
        opaque: (H, W) where the photograph from here is, if it has alpha, else None.
    """
    few = (evidence.count < AGREE).reshape(eye.open.shape)
    return eye.counts & eye.open & (few if opaque is None else opaque)


def floating(eye: Eye, evidence: Evidence) -> Bools:
    """(H, W) pixels that show what photographs see past, and at most one sees."""
    found = (evidence.passed >= AGREE) & (evidence.count < AGREE)
    return eye.counts & ~eye.open & found.reshape(eye.open.shape)


def near_floaters(gaussians: Gaussians, eyes: Sequence[Eye], nearest: float) -> Floaters:
    """Opaque Gaussians nearer to a camera than any surface, past which photographs see.

    Args:
        eyes: of the training views.
        nearest: distance of the nearest surfaces that photographs agree on, world unit.
    """
    from scipy.spatial import cKDTree

    within = NEAR_SHARE * nearest
    means = gaussians.means.numpy().astype(np.float64)
    centres = np.stack([eye.view.centre for eye in eyes])
    logit = float(np.log(MIN_OPACITY / (1 - MIN_OPACITY)))
    opaque = np.flatnonzero(gaussians.opacity_logits.numpy() >= logit)
    distance, camera = cKDTree(centres).query(means[opaque], distance_upper_bound=within)
    close = np.isfinite(distance)
    xyz, camera = means[opaque[close]], camera[close]
    seen, passed = np.zeros((2, len(xyz)), int)
    for eye in eyes:
        sighting = look_for(eye, xyz, np.zeros(len(xyz), bool))
        seen[sighting.seen] += 1
        passed += sighting.passed
    found = camera[(seen < AGREE) & (passed >= AGREE)]
    names = Counter(eyes[i].view.name for i in found)
    ranked = sorted(names.items(), key=lambda item: (-item[1], item[0]))
    return Floaters(len(found), within, dict(ranked[:NAMED]))
