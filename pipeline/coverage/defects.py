"""What is wrong where few photographs look: rays without a surface, and floaters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.coverage.probe_views import Bools, Eye, look_for
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
    """Opaque Gaussians that stand before cameras, nearer than any surface.

    Attributes:
        count: how many.
        within: distance from a camera up to which they were sought, world unit; 0 where
            photographs agree on no surface.
        cameras: names of the cameras that show them, those with most first, with their number.
    """

    count: int
    within: float
    cameras: dict[str, int]


def holes(eye: Eye, evidence: Evidence, opaque: Bools | None) -> Bools:
    """(H, W) pixels whose rays meet no surface, though there is one, or though fewer than ``AGREE``
    photographs say that there is none.

    Args:
        opaque: (H, W) where the photograph from here is, if it has alpha, else None.
    """
    few = (evidence.count < AGREE).reshape(eye.open.shape)
    return eye.counts & eye.open & (few if opaque is None else opaque)


def floating(eye: Eye, evidence: Evidence, nearest: float) -> Bools:
    """(H, W) pixels that show what fewer than ``AGREE`` photographs see, and what as many see past
    or what is nearer than any surface.

    Args:
        nearest: distance of the nearest surfaces that photographs agree on, world unit.
    """
    shape = eye.open.shape
    few, passed = (evidence.count < AGREE).reshape(shape), evidence.passed.reshape(shape) >= AGREE
    return eye.counts & ~eye.open & few & (passed | (eye.depth < NEAR_SHARE * nearest))


def near_floaters(
    gaussians: Gaussians, training: Sequence[Eye], others: Sequence[Eye], nearest: float
) -> Floaters:
    """Opaque Gaussians that a camera shows nearer than any surface, and of the training views fewer
    than ``AGREE``.

    Args:
        others: of held-out views.
        nearest: as for ``floating``.
    """
    from scipy.spatial import cKDTree

    within = NEAR_SHARE * nearest
    eyes = [*training, *others]
    means = gaussians.means.numpy().astype(np.float64)
    logit = float(np.log(MIN_OPACITY / (1 - MIN_OPACITY)))
    opaque = means[gaussians.opacity_logits.numpy() >= logit]
    centres = np.stack([eye.view.centre for eye in eyes])
    reached, _ = cKDTree(centres).query(opaque, distance_upper_bound=within)
    xyz = opaque[np.isfinite(reached)]
    seen, shown = np.zeros(len(xyz), int), np.full(len(xyz), -1)
    for i, eye in enumerate(eyes):
        found = look_for(eye, xyz, np.zeros(len(xyz), bool)).seen
        seen[found] += i < len(training)
        close = np.linalg.norm(xyz[found] - eye.view.centre, axis=1) <= within
        shown[found[close]] = i
    named = Counter(eyes[i].view.name for i in shown[(seen < AGREE) & (shown >= 0)])
    ranked = sorted(named.items(), key=lambda item: (-item[1], item[0]))
    return Floaters(named.total(), within, dict(ranked[:NAMED]))
