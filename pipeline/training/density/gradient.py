"""Adaptive density control after Kerbl et al. 2023, section 5.2, under a budget.

Gaussians whose image position the loss pulls at are split or cloned; faint and huge ones go.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.config.schema import Density
from pipeline.render import Forward, Gradients
from pipeline.splats.gaussians import Gaussians
from pipeline.training.density.strategy import Changes, not_finite, rotations
from pipeline.training.optimisers.adam import Adam

# A sampled split makes two, each this much smaller: 0.8 N with N = 2 (3DGS).
SPLIT_SHRINK = 1.6
# A split along the longest axis (after Deng et al. 2025): what is left of the scale along it, of
# the others, and of the opacity. Two stand so far from the middle that the variance along it stays.
LONG_AXIS, OTHER_AXES, HALVES_OPACITY = 0.5, 0.85, 0.8
LONG_OFFSET = math.sqrt(1 - LONG_AXIS**2)
RESET_OPACITY = 0.01
# What shows less than this may make room for others, if it is of this share that is pulled at
# least: what is faint because it is new is pulled at (docs/explanation/training.md).
RECYCLED_OPACITY, IDLE_SHARE = 0.1, 0.1


@dataclass
class GradientDensity:
    """Split, and where it is asked for clone the small of, Gaussians whose image position the loss
    pulls at; remove faint and huge ones.

    Attributes:
        config: thresholds and the budget.
        scale: the scene's size (``training.data.known_depths.scene_scale``), for thresholds on
            scales.
        gradient_sum: (N,) float32, summed norms of the gradient of the projected mean, in
            normalised device coordinates (so that it doesn't depend on the resolution).
        seen: (N,) float32, number of steps in which the Gaussian was visible.
    """

    config: Density
    scale: float
    gradient_sum: Tensor = field(default_factory=lambda: torch.zeros(0))
    seen: Tensor = field(default_factory=lambda: torch.zeros(0))

    def start(self, count: int) -> None:
        self.gradient_sum, self.seen = torch.zeros(count), torch.zeros(count)

    def regularise(self, gaussians: Gaussians, gradients: Gradients) -> None:
        """Nothing: the paper has no loss of this kind."""

    def observe(self, forward: Forward, gradients: Gradients, width: int, height: int) -> None:
        pull = gradients.means2d
        if self.config.absolute_gradient:
            assert gradients.means2d_abs is not None
            pull = gradients.means2d_abs
        # Pixels to normalised device coordinates: x_ndc = 2 x / width - 1.
        self.gradient_sum += torch.hypot(pull[:, 0] * (0.5 * width), pull[:, 1] * (0.5 * height))
        self.seen += forward.radii > 0

    def explore(self, gaussians: Gaussians, pace: float, rng: np.random.Generator) -> None:
        """Nothing: chance has a part in splits alone."""

    def refine(
        self,
        gaussians: Gaussians,
        adam: Adam,
        rng: np.random.Generator,
        *,
        densify: bool,
        prune_huge: bool,
        budget: int,
    ) -> tuple[Gaussians, Changes]:
        """Prune, then (``densify``) split and clone."""
        kept = ~self._useless(gaussians, prune_huge)
        grow = torch.zeros_like(kept)
        if densify:
            pull = self.gradient_sum / self.seen.clamp(min=1.0)
            wanted = kept & (pull > self.config.grad_threshold)
            kept = kept & ~self._recycled(gaussians, kept, pull, wanted, budget)
            # Each adds one Gaussian, cloned or split.
            grow = most(pull, wanted & kept, max(0, budget - int(kept.sum())))
        changes = Changes(pruned=len(gaussians) - int(kept.sum()))
        large = self._large(gaussians)
        cloned = torch.nonzero(grow & ~large)[:, 0]
        split = torch.nonzero(grow & large)[:, 0]
        stay = torch.nonzero(kept & ~(grow & large))[:, 0]
        changes.cloned, changes.split = len(cloned), len(split)

        rows = torch.cat([stay, cloned, split, split])
        fresh = torch.arange(len(rows)) >= len(stay)
        result = gaussians.select(rows)
        adam.select(rows, fresh)
        if len(split):
            children = slice(len(stay) + len(cloned), None)
            if self.config.split_kind == "long_axis":
                _halve(result, children)
            else:
                result.means[children] += _offsets(result, children, rng)
                result.log_scales[children] -= math.log(SPLIT_SHRINK)
        self.start(len(result))
        return result, changes

    def reset_opacity(self, gaussians: Gaussians, adam: Adam) -> None:
        """Cap every opacity at ``RESET_OPACITY``: what is needed comes back, floaters do not."""
        gaussians.opacity_logits.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
        adam.forget("opacity_logits")

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"gradient_sum": self.gradient_sum.numpy(), "seen": self.seen.numpy()}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        self.gradient_sum = torch.from_numpy(arrays["gradient_sum"])
        self.seen = torch.from_numpy(arrays["seen"])

    def _useless(self, gaussians: Gaussians, prune_huge: bool) -> Tensor:
        """(N,) bool: too faint, too large (``prune_huge``), or no longer a number."""
        useless = torch.sigmoid(gaussians.opacity_logits) < self.config.prune_opacity
        if prune_huge:
            useless |= self._longest(gaussians) > self.config.prune_scale * self.scale
        return useless | not_finite(gaussians)

    def _large(self, gaussians: Gaussians) -> Tensor:
        """(N,) bool: those that split rather than clone, where both are allowed."""
        if not (self.config.clone and self.config.split):
            return torch.full((len(gaussians),), self.config.split)
        return self._longest(gaussians) > self.config.split_scale * self.scale

    def _recycled(
        self, gaussians: Gaussians, kept: Tensor, pull: Tensor, wanted: Tensor, budget: int
    ) -> Tensor:
        """(N,) bool: the faintest of the idle, which make room where more are wanted than the
        budget has left. Otherwise the first details would keep the budget, and what is bare would
        stay bare."""
        short = int(wanted.sum()) - max(0, budget - int(kept.sum()))
        limit = min(short, round(self.config.recycle * budget))
        idle = most(-pull, kept, round(IDLE_SHARE * int(kept.sum())))
        opacity = torch.sigmoid(gaussians.opacity_logits)
        return most(-opacity, idle & (opacity < RECYCLED_OPACITY), limit)

    @staticmethod
    def _longest(gaussians: Gaussians) -> Tensor:
        return gaussians.log_scales.amax(1).exp()


def most(score: Tensor, among: Tensor, count: int) -> Tensor:
    """(N,) bool: the ``count`` highest scores ``among`` (N,) bool; the first of equal ones."""
    if int(among.sum()) <= count:
        return among
    chosen = torch.zeros_like(among)
    if count > 0:
        lowest = torch.full_like(score, -math.inf)
        order = torch.argsort(score.where(among, lowest), descending=True, stable=True)
        chosen[order[:count]] = True
    return chosen


def _halve(gaussians: Gaussians, rows: slice) -> None:
    """Set ``rows`` (2 M), M Gaussians and the same again, side by side along their longest axes, in
    place."""
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


def _offsets(gaussians: Gaussians, rows: slice, rng: np.random.Generator) -> Tensor:
    """(M, 3) draws from each Gaussian of ``rows`` about its mean."""
    scales = gaussians.log_scales[rows].exp()
    noise = torch.from_numpy(rng.standard_normal(scales.shape, np.float32))
    return torch.einsum("nij,nj->ni", rotations(gaussians.quats[rows]), scales * noise)
