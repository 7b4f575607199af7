"""Cloning and splitting of Gaussians: what the strategies ``gradient`` and ``original`` share."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.splats.gaussians import Geometry
from pipeline.training.density.strategy import (
    Changes,
    DensityStep,
    Refinement,
    rotations,
)

# A sampled split divides the scales by 0.8 N with N = 2 (3DGS).
SPLIT_SHRINK = 1.6
# A split along the longest axis (after Deng et al. 2025): factors of the scale along it, of the
# other scales and of the opacity. The offset of the halves keeps the variance along the axis.
LONG_AXIS, OTHER_AXES, HALVES_OPACITY = 0.5, 0.85, 0.8
LONG_OFFSET = math.sqrt(1 - LONG_AXIS**2)
RESET_OPACITY = 0.01


@dataclass
class GradientStatistics:
    """The gradients of the projected centres since the last densification.

    Attributes:
        gradient_sum: (N,) float32, the sum of the norms of the gradients of the projected centres,
            in normalised device coordinates (independent of the resolution).
        seen: (N,) float32, the number of steps in which the Gaussian was visible.
    """

    gradient_sum: Tensor = field(default_factory=lambda: torch.zeros(0))
    seen: Tensor = field(default_factory=lambda: torch.zeros(0))

    def start(self, count: int) -> None:
        self.gradient_sum, self.seen = torch.zeros(count), torch.zeros(count)

    def mean(self) -> Tensor:
        """(N,) mean norm of the gradient over the steps in which the Gaussian was visible."""
        return self.gradient_sum / self.seen.clamp(min=1.0)

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"gradient_sum": self.gradient_sum.numpy(), "seen": self.seen.numpy()}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        self.gradient_sum = torch.from_numpy(arrays["gradient_sum"])
        self.seen = torch.from_numpy(arrays["seen"])


Halving = Callable[[Geometry], Mapping[str, Tensor]]
"""Returns the arrays that change by name, for 2 M Gaussians: M and their copies."""


def multiply(
    step: DensityStep, kept: Tensor, cloned: Tensor, split: Tensor, halved: Halving
) -> Refinement:
    """Remove all but ``kept``, and add a copy of each row of ``cloned`` and ``split``, (N,) bool
    masks of different rows. Copies have no moments, nor have the rows that are split.

    Args:
        halved: Gives the rows that are split, and their copies, other values.

    Returns:
        First the Gaussians that stay, then the clones, then the first halves of those that are
        split, then the second ones.
    """
    changes = Changes(pruned=len(kept) - int(kept.sum()))
    clones, halves = torch.nonzero(cloned)[:, 0], torch.nonzero(split)[:, 0]
    stay = torch.nonzero(kept & ~split)[:, 0]
    changes.cloned, changes.split = len(clones), len(halves)
    both = torch.cat([halves, halves])
    rows = torch.cat([stay, clones, both])
    number = torch.arange(len(rows))
    values = halved(step.geometry.select(both, step.threads)) if changes.split else {}
    changed = number[len(rows) - len(both) :]
    return Refinement(rows, number >= len(stay), changed, values, changes)


def along_longest_axis(halves: Geometry) -> dict[str, Tensor]:
    """A ``Halving``: each pair lies side by side along the longest axis, and is smaller and more
    transparent."""
    log_scales = halves.log_scales
    each, longest = torch.arange(len(log_scales)), log_scales.argmax(1)
    axis = rotations(halves.quats)[each, :, longest]
    far = LONG_OFFSET * log_scales[each, longest].exp()
    far[len(far) // 2 :] *= -1
    smaller = log_scales + math.log(OTHER_AXES)
    smaller[each, longest] += math.log(LONG_AXIS / OTHER_AXES)
    opacity = HALVES_OPACITY * torch.sigmoid(halves.opacity_logits)
    return {
        "means": halves.means + far[:, None] * axis,
        "log_scales": smaller,
        "opacity_logits": torch.logit(opacity),
    }


def sampled(halves: Geometry, rng: np.random.Generator) -> dict[str, Tensor]:
    """A ``Halving``: positions are drawn from each Gaussian, and scales are smaller (3DGS)."""
    scales = halves.log_scales.exp()
    noise = torch.from_numpy(rng.standard_normal(scales.shape, np.float32))
    offset = torch.einsum("nij,nj->ni", rotations(halves.quats), scales * noise)
    return {
        "means": halves.means + offset,
        "log_scales": halves.log_scales - math.log(SPLIT_SHRINK),
    }


def longest_scale(geometry: Geometry) -> Tensor:
    """(N,) the largest scale of each Gaussian, world units."""
    return geometry.log_scales.amax(1).exp()


def limit_opacity(geometry: Geometry, unlimited: Tensor | None = None) -> None:
    """Limit every opacity to ``RESET_OPACITY``, in place; those of useful Gaussians recover.

    Args:
        unlimited: (N,) bool, the rows that keep their opacity. None: none of them.
    """
    limit = torch.full_like(geometry.opacity_logits, math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    if unlimited is not None:
        limit[unlimited] = math.inf
    torch.minimum(geometry.opacity_logits, limit, out=geometry.opacity_logits)
