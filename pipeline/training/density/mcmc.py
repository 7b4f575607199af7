"""Density control as sampling after Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain
Monte Carlo": useless Gaussians are laid onto useful ones so that the picture stays the same, the
set grows by a share at a time up to the budget, noise moves the faint ones, and opacity and scale
cost something."""

from __future__ import annotations

import math
from dataclasses import dataclass
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

# More copies of one Gaussian in one refinement than this change nothing any more (the paper's code
# has 51).
MAX_COPIES = 51
# A Gaussian moves at random if it is fainter than about this: the paper's logistic of slope 100
# about 0.005. At 20 times the share of the noise is 1e-4, and left away.
FAINT, FAINT_SLOPE, STILL = 0.005, 100.0, 0.1
# The noise's size over the means' learning rate (the paper's).
NOISE = 5e5
LR_MEANS = 1.6e-4  # the rate of the means that it is times, in scene's sizes
MAX_OPACITY = 1 - 1e-6


@dataclass
class McmcDensity:
    """Attributes:
    config: growth, threshold of the useless, weights of the regularisers.
    scale: the scene's size (``training.data.known_depths.scene_scale``). The paper's cost of
        scales and its noise count in the world's unit; here they count in that size, so that the
        unit does not matter.
    """

    config: Density
    scale: float

    def start(self, count: int) -> None:
        pass

    def regularise(self, gaussians: Gaussians, gradients: Gradients) -> None:
        """The paper's equation 10: the means of the opacities and of the scales are added to the
        loss."""
        if self.config.opacity_cost:
            opacity = torch.sigmoid(gaussians.opacity_logits)
            weight = self.config.opacity_cost / len(gaussians)
            gradients.opacity_logits.add_(opacity * (1 - opacity), alpha=weight)
        if self.config.scale_cost:
            weight = self.config.scale_cost / (self.scale * gaussians.log_scales.numel())
            gradients.log_scales.add_(gaussians.log_scales.exp(), alpha=weight)

    def observe(self, forward: Forward, gradients: Gradients, width: int, height: int) -> None:
        pass

    def explore(self, gaussians: Gaussians, pace: float, rng: np.random.Generator) -> None:
        """The paper's equation 8: noise shaped by the Gaussian's covariance, for the faint."""
        if not self.config.noise:
            return
        opacity = torch.sigmoid(gaussians.opacity_logits)
        moved = torch.nonzero(opacity < STILL)[:, 0]
        if not len(moved):
            return
        share = torch.sigmoid(-FAINT_SLOPE * (opacity[moved] - FAINT))
        draws = torch.from_numpy(rng.standard_normal((len(moved), 3), np.float32))
        axes = rotations(gaussians.quats[moved])
        variances = (2 * gaussians.log_scales[moved]).exp()
        noise = torch.einsum("nij,nj,nkj,nk->ni", axes, variances, axes, draws)
        gaussians.means[moved] += noise * (share * (NOISE * LR_MEANS * pace / self.scale))[:, None]

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
        """Relocate the useless onto draws of the useful, by opacity, and grow; without
        ``densify``, remove the useless. Huge Gaussians are left to the regulariser."""
        useless = torch.sigmoid(gaussians.opacity_logits) <= self.config.prune_opacity
        useless |= not_finite(gaussians)
        alive = torch.nonzero(~useless)[:, 0]
        dead = int(useless.sum())
        if not densify or not len(alive):
            adam.select(alive, torch.zeros(len(alive), dtype=torch.bool))
            return gaussians.select(alive), Changes(pruned=dead)
        grown = min(budget, math.ceil(len(gaussians) * (1 + self.config.growth)))
        added = max(0, grown - len(gaussians))
        opacity = torch.sigmoid(gaussians.opacity_logits[alive]).double().numpy()
        chosen = rng.choice(len(alive), size=dead + added, p=opacity / opacity.sum())
        copies = torch.from_numpy(np.bincount(chosen, minlength=len(alive)))
        sources = alive[torch.from_numpy(np.sort(chosen))]
        shared = gaussians.clone()
        touched = copies > 0
        rows = alive[touched]
        logits, shrink = share_out(
            gaussians.opacity_logits[rows], copies[touched] + 1, self.config.prune_opacity
        )
        shared.opacity_logits[rows] = logits
        shared.log_scales[rows] += shrink[:, None]
        # Moments of what was shared out are of another Gaussian: all of them start anew.
        for moments in (adam.first, adam.second):
            for tensor in moments.values():
                tensor[rows] = 0.0
        order = torch.cat([alive, sources])
        adam.select(order, torch.arange(len(order)) >= len(alive))
        return shared.select(order), Changes(cloned=added, relocated=dead)

    def reset_opacity(self, gaussians: Gaussians, adam: Adam) -> None:
        """Never: the regulariser does what a reset is for."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        pass


def share_out(logits: Tensor, parts: Tensor, min_opacity: float) -> tuple[Tensor, Tensor]:
    """What ``parts`` (M,) Gaussians in one place must be, each, to look like the one there was:
    the paper's equation 9.

    Args:
        logits: (M,) of the opacities there were.

    Returns:
        (M,) logits of the new opacities, and (M,) what is added to each log scale.
    """
    parts = parts.clamp(max=MAX_COPIES)
    old = torch.sigmoid(logits.double()).clamp(max=MAX_OPACITY)
    new = 1 - (1 - old) ** (1 / parts)
    # sum_{i=1}^{n} sum_{k=0}^{i-1} C(i-1, k) (-1)^k o^(k+1) / sqrt(k+1): the inner sums over i are
    # C(n, k+1). Alternating terms of up to C(51, 25) leave no digits, so the integral that the sum
    # stands for is taken instead: (1/sqrt(pi)) int (1 - (1 - o exp(-t^2))^n) dt.
    t = torch.linspace(0, 6, 385, dtype=torch.float64)
    covered = 1 - (1 - new[:, None] * torch.exp(-t * t)) ** parts[:, None]
    total = torch.trapezoid(covered, t, dim=1) * (2 / math.sqrt(math.pi))
    shrink = torch.log(old / total)
    new = new.clamp(min_opacity, MAX_OPACITY)
    return torch.logit(new).float(), shrink.float()
