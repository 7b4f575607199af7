"""Adaptive density control after Kerbl et al. 2023, section 5.2, under a budget.

A strategy watches every step (``observe``) and now and then changes the set of Gaussians
(``refine``, ``reset_opacity``); when, is the schedule's business.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from pipeline.config.schema import Density
from pipeline.raster import Forward, Gradients
from pipeline.splats.gaussians import Gaussians
from pipeline.training.optimiser import Adam

# A split makes two, each this much smaller: 0.8 N with N = 2 (3DGS).
SPLIT_SHRINK = 1.6
RESET_OPACITY = 0.01


@dataclass
class Changes:
    """Counts of one ``refine``."""

    cloned: int = 0
    split: int = 0
    pruned: int = 0

    def add(self, other: Changes) -> None:
        self.cloned += other.cloned
        self.split += other.split
        self.pruned += other.pruned


@dataclass
class GradientDensity:
    """Clone small and split large Gaussians whose image position the loss pulls at; remove
    faint and huge ones.

    Attributes:
        config: thresholds and the budget.
        extent: the scene's size in the world's unit, for thresholds on scales.
        gradient_sum: (N,) float32, summed norms of the gradient of the projected mean, in
            normalised device coordinates (so that it doesn't depend on the resolution).
        seen: (N,) float32, number of steps in which the Gaussian was visible.
    """

    config: Density
    extent: float
    gradient_sum: Tensor = field(default_factory=lambda: torch.zeros(0))
    seen: Tensor = field(default_factory=lambda: torch.zeros(0))

    def start(self, count: int) -> None:
        """Forget what was observed; ``count`` Gaussians from here on."""
        self.gradient_sum, self.seen = torch.zeros(count), torch.zeros(count)

    def observe(self, forward: Forward, gradients: Gradients, width: int, height: int) -> None:
        """Take note of one step's view of ``width`` x ``height`` pixels."""
        pull = gradients.means2d
        if self.config.absolute_gradient:
            assert gradients.means2d_abs is not None
            pull = gradients.means2d_abs
        # Pixels to normalised device coordinates: x_ndc = 2 x / width - 1.
        self.gradient_sum += torch.hypot(pull[:, 0] * (0.5 * width), pull[:, 1] * (0.5 * height))
        self.seen += forward.radii > 0

    def refine(
        self,
        gaussians: Gaussians,
        adam: Adam,
        rng: np.random.Generator,
        *,
        densify: bool,
        prune_huge: bool,
    ) -> tuple[Gaussians, Changes]:
        """Prune, then (``densify``) clone and split; ``adam`` follows. What was observed is
        forgotten. Never more than ``config.max_gaussians`` come out, unless more came in."""
        kept = ~self._useless(gaussians, prune_huge)
        changes = Changes(pruned=len(gaussians) - int(kept.sum()))
        grow = self._wanted(kept) if densify else torch.zeros_like(kept)
        large = self._longest(gaussians) > self.config.split_scale * self.extent
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
            result.means[children] += _offsets(result, children, rng)
            result.log_scales[children] -= math.log(SPLIT_SHRINK)
        self.start(len(result))
        return result, changes

    def reset_opacity(self, gaussians: Gaussians, adam: Adam) -> None:
        """Cap every opacity at ``RESET_OPACITY``: what is needed comes back, floaters do not."""
        gaussians.opacity_logits.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
        adam.forget("opacity_logits")

    def _useless(self, gaussians: Gaussians, prune_huge: bool) -> Tensor:
        """(N,) bool: too faint, too large (``prune_huge``), or no longer a number."""
        useless = torch.sigmoid(gaussians.opacity_logits) < self.config.prune_opacity
        if prune_huge:
            useless |= self._longest(gaussians) > self.config.prune_scale * self.extent
        for tensor in gaussians.tensors().values():
            useless |= ~torch.isfinite(tensor).reshape(len(tensor), tensor[:1].numel()).all(1)
        return useless

    def _wanted(self, kept: Tensor) -> Tensor:
        """(N,) bool: those over the threshold, the most wanted ones first where the budget is
        short. Each adds one Gaussian, cloned or split."""
        gradient = self.gradient_sum / self.seen.clamp(min=1.0)
        wanted = kept & (gradient > self.config.grad_threshold)
        room = max(0, self.config.max_gaussians - int(kept.sum()))
        if int(wanted.sum()) > room:
            order = torch.argsort(gradient.where(wanted, -1.0), descending=True, stable=True)
            wanted = torch.zeros_like(wanted)
            wanted[order[:room]] = True
        return wanted

    @staticmethod
    def _longest(gaussians: Gaussians) -> Tensor:
        return gaussians.log_scales.amax(1).exp()


def _offsets(gaussians: Gaussians, rows: slice, rng: np.random.Generator) -> Tensor:
    """(M, 3) draws from each Gaussian of ``rows`` about its mean."""
    scales = gaussians.log_scales[rows].exp()
    noise = torch.from_numpy(rng.standard_normal(scales.shape, np.float32))
    return torch.einsum("nij,nj->ni", rotations(gaussians.quats[rows]), scales * noise)


def rotations(quats: Tensor) -> Tensor:
    """(N, 3, 3) rotation matrices of quaternions (N, 4) wxyz of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    return torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        1,
    ).view(-1, 3, 3)
