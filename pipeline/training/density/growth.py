"""Cloning and splitting of Gaussians: what the strategies ``gradient`` and ``original`` share."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.splats.gaussians import Gaussians
from pipeline.training.density.strategy import Changes, DensityStep, rotations
from pipeline.training.optimisers.adam import Adam

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


@dataclass(frozen=True)
class Multiplied:
    """The Gaussians after ``multiply``.

    Attributes:
        gaussians: First those that stayed, then the clones, then the halves of the split ones.
        halves: The rows of the halves (2 M): the first ones of M Gaussians, then the second ones.
            They are still equal to the Gaussian that was split.
    """

    gaussians: Gaussians
    halves: slice
    changes: Changes


def multiply(step: DensityStep, kept: Tensor, cloned: Tensor, split: Tensor) -> Multiplied:
    """Remove all but ``kept``, and add a copy of each row of ``cloned`` and ``split``, (N,) bool
    masks of different rows. Copies have no moments, nor have the rows that are split."""
    changes = Changes(pruned=len(kept) - int(kept.sum()))
    clones, halves = torch.nonzero(cloned)[:, 0], torch.nonzero(split)[:, 0]
    stay = torch.nonzero(kept & ~split)[:, 0]
    changes.cloned, changes.split = len(clones), len(halves)
    rows = torch.cat([stay, clones, halves, halves])
    step.adam.select(rows, torch.arange(len(rows)) >= len(stay), step.threads)
    return Multiplied(
        step.gaussians.select(rows, step.threads),
        slice(len(stay) + len(clones), len(rows)),
        changes,
    )


def halve_along_longest_axis(gaussians: Gaussians, rows: slice) -> None:
    """Move and shrink ``rows`` (2 M), M Gaussians and their copies, in place: each pair lies side
    by side along the longest axis."""
    log_scales = gaussians.log_scales[rows]
    each, longest = torch.arange(len(log_scales)), log_scales.argmax(1)
    axis = rotations(gaussians.quats[rows])[each, :, longest]
    far = LONG_OFFSET * log_scales[each, longest].exp()
    far[len(far) // 2 :] *= -1
    gaussians.means[rows] += far[:, None] * axis
    log_scales = log_scales + math.log(OTHER_AXES)
    log_scales[each, longest] += math.log(LONG_AXIS / OTHER_AXES)
    gaussians.log_scales[rows] = log_scales
    opacity = HALVES_OPACITY * torch.sigmoid(gaussians.opacity_logits[rows])
    gaussians.opacity_logits[rows] = torch.logit(opacity)


def sample_halves(gaussians: Gaussians, rows: slice, rng: np.random.Generator) -> None:
    """Move ``rows`` to positions drawn from each Gaussian, and shrink them, in place (3DGS)."""
    scales = gaussians.log_scales[rows].exp()
    noise = torch.from_numpy(rng.standard_normal(scales.shape, np.float32))
    axes = rotations(gaussians.quats[rows])
    gaussians.means[rows] += torch.einsum("nij,nj->ni", axes, scales * noise)
    gaussians.log_scales[rows] -= math.log(SPLIT_SHRINK)


def longest_scale(gaussians: Gaussians) -> Tensor:
    """(N,) the largest scale of each Gaussian, world units."""
    return gaussians.log_scales.amax(1).exp()


def limit_opacity(gaussians: Gaussians, adam: Adam, unlimited: Tensor | None = None) -> None:
    """Limit every opacity to ``RESET_OPACITY``, in place; those of useful Gaussians recover.

    Args:
        unlimited: (N,) bool, the rows that keep their opacity. None: none of them.
    """
    limit = torch.full_like(gaussians.opacity_logits, math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    if unlimited is not None:
        limit[unlimited] = math.inf
    torch.minimum(gaussians.opacity_logits, limit, out=gaussians.opacity_logits)
    adam.forget("opacity_logits")
