"""The strategy ``mcmc``: 3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024).

Transparent Gaussians are relocated onto opaque ones such that the rendered images stay the same,
the set grows by a share at a time up to the budget, noise moves transparent Gaussians, and
regularisers lower opacities and scales.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from pipeline.config.experiments import McmcExperiments
from pipeline.render import Forward, Gradients
from pipeline.splats.gaussians import Gaussians, Geometry
from pipeline.training.density.strategy import (
    Changes,
    DensityStep,
    Refinement,
    Strategy,
    Update,
    rotations,
    useless_values,
)
from pipeline.training.density.timeline import Timeline

# Upper limit of the copies of one Gaussian in one refinement (the authors' code).
MAX_COPIES = 51
# The share of the noise is a logistic function of the opacity: this midpoint and slope in the
# authors' code. Above NOISE_OPACITY the share is below 1e-4 and taken as 0.
NOISE_MIDPOINT, NOISE_SLOPE, NOISE_OPACITY = 0.005, 100.0, 0.1
# The noise is this factor (the authors' code) times the learning rate of the means, of 3DGS's
# initial value in scene sizes.
NOISE, MEANS_LEARNING_RATE = 5e5, 1.6e-4
MAX_OPACITY = 1 - 1e-6


@dataclass
class McmcDensity(Strategy):
    """Relocation, growth and noise.

    Attributes:
        options: The growth, the pruning threshold and the weights of the regularisers.
        steps: The length of the schedule.
        scale: The size of the scene (``training.data.known_depths.scene_scale``). The paper's scale
            loss and noise are in world units; here they are in this unit, so that results do not
            depend on the world's unit.
    """

    options: McmcExperiments
    steps: int
    scale: float
    timeline: Timeline = field(init=False)

    def __post_init__(self) -> None:
        self.timeline = Timeline.of(self.options, self.steps)

    def is_due(self, steps: range) -> bool:
        return self._has_noise(steps) or super().is_due(steps)

    def start(self, count: int) -> None:
        """Do nothing: this strategy observes no statistics."""

    def before_step(self, gaussians: Gaussians, rendered: Forward, gradients: Gradients) -> None:
        """Add the gradients of the mean opacity and the mean scale (equation 10)."""
        if self.options.opacity_loss_weight:
            opacity = torch.sigmoid(gaussians.opacity_logits)
            weight = self.options.opacity_loss_weight / len(gaussians)
            gradients.opacity_logits.add_(opacity * (1 - opacity), alpha=weight)
        if self.options.scale_loss_weight:
            weight = self.options.scale_loss_weight / (self.scale * gaussians.log_scales.numel())
            gradients.log_scales.add_(gaussians.log_scales.exp(), alpha=weight)

    def after_step(self, step: DensityStep) -> Update:
        if self._has_noise(step.steps):
            self._add_noise(step.geometry, step.noise_rate, step.rng)
        return super().after_step(step)

    def _has_noise(self, steps: range) -> bool:
        return self.options.noise and steps.stop - 1 <= self.timeline.stop

    def _add_noise(self, geometry: Geometry, rate: float, rng: np.random.Generator) -> None:
        """Move transparent Gaussians by noise of their covariance (equation 8), in place."""
        opacity = torch.sigmoid(geometry.opacity_logits)
        moved = torch.nonzero(opacity < NOISE_OPACITY)[:, 0]
        if not len(moved):
            return
        share = torch.sigmoid(-NOISE_SLOPE * (opacity[moved] - NOISE_MIDPOINT))
        draws = torch.from_numpy(rng.standard_normal((len(moved), 3), np.float32))
        axes = rotations(geometry.quats[moved])
        variances = (2 * geometry.log_scales[moved]).exp()
        noise = torch.einsum("nij,nj,nkj,nk->ni", axes, variances, axes, draws)
        size = NOISE * MEANS_LEARNING_RATE * rate / self.scale
        geometry.means[moved] += noise * (share * size)[:, None]

    def refine(self, step: DensityStep) -> Refinement:
        """Relocate transparent Gaussians onto others, drawn by opacity, and grow; without
        densification, remove them. Large Gaussians are left to the regulariser."""
        geometry = step.geometry
        useless = torch.sigmoid(geometry.opacity_logits) <= self.options.prune_opacity
        useless |= useless_values(step)
        alive = torch.nonzero(~useless)[:, 0]
        dead = int(useless.sum())
        opacity = torch.sigmoid(geometry.opacity_logits[alive]).double()
        weights = opacity.masked_fill(step.frozen[alive], 0.0).numpy()
        if not self.densifies_after(step.steps) or not weights.any():
            fresh = torch.zeros(len(alive), dtype=torch.bool)
            return Refinement(alive, fresh, torch.nonzero(fresh)[:, 0], {}, Changes(pruned=dead))
        grown = min(step.budget, math.ceil(len(geometry) * (1 + self.options.growth_share)))
        added = max(0, grown - len(geometry))
        chosen = step.rng.choice(len(alive), size=dead + added, p=weights / weights.sum())
        copies = torch.from_numpy(np.bincount(chosen, minlength=len(alive)))
        sources = alive[torch.from_numpy(np.sort(chosen))]
        shared = torch.nonzero(copies)[:, 0]
        logits, shrink = share_out(
            geometry.opacity_logits[alive[shared]], copies[shared] + 1, self.options.prune_opacity
        )
        log_scales = geometry.log_scales[alive[shared]] + shrink[:, None]
        rows = torch.cat([alive, sources])
        # (N,) int64, the place of each row in ``shared``, or -1.
        place = torch.full((len(geometry),), -1)
        place[alive[shared]] = torch.arange(len(shared))
        # The moments of relocated-onto Gaussians belong to the old opacity and scale.
        fresh = place[rows] >= 0
        changed = torch.nonzero(fresh)[:, 0]
        which = place[rows[changed]]
        values = {"opacity_logits": logits[which], "log_scales": log_scales[which]}
        return Refinement(rows, fresh, changed, values, Changes(cloned=added, relocated=dead))


def share_out(logits: Tensor, parts: Tensor, min_opacity: float) -> tuple[Tensor, Tensor]:
    """Opacities and scales of ``parts`` (M,) equal Gaussians that render like one (equation 9).

    Args:
        logits: (M,) logits of the opacities of the single Gaussians.

    Returns:
        (M,) logits of the new opacities, and (M,) changes of the log scales.
    """
    parts = parts.clamp(max=MAX_COPIES)
    old = torch.sigmoid(logits.double()).clamp(max=MAX_OPACITY)
    new = 1 - (1 - old) ** (1 / parts)
    # sum_{i=1}^{n} sum_{k=0}^{i-1} C(i-1, k) (-1)^k o^(k+1) / sqrt(k+1): the inner sums over i are
    # C(n, k+1). Alternating terms of up to C(51, 25) cancel all digits, so the sum is computed as
    # the integral (1/sqrt(pi)) int (1 - (1 - o exp(-t^2))^n) dt.
    t = torch.linspace(0, 6, 385, dtype=torch.float64)
    covered = 1 - (1 - new[:, None] * torch.exp(-t * t)) ** parts[:, None]
    total = torch.trapezoid(covered, t, dim=1) * (2 / math.sqrt(math.pi))
    shrink = torch.log(old / total)
    new = new.clamp(min_opacity, MAX_OPACITY)
    return torch.logit(new).float(), shrink.float()
