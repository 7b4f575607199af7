"""The strategy ``gradient``: density control after Kerbl et al. 2023, section 5.2, with a budget.

Gaussians with large gradients of their projected centres are split, the largest gradients first;
transparent and large ones are removed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.config.experiments import GradientExperiments
from pipeline.splats.gaussians import Geometry
from pipeline.splats.skybox import Sky
from pipeline.training.density.growth import (
    GradientStatistics,
    along_longest_axis,
    limit_opacity,
    longest_scale,
    multiply,
)
from pipeline.training.density.strategy import (
    DensityStep,
    Refinement,
    Strategy,
    highest,
    useless_values,
)
from pipeline.training.density.timeline import Timeline, shrunk

# Only Gaussians below this opacity are recycled, and only those among this share with the smallest
# gradients: new Gaussians are transparent as well, but have large gradients.
RECYCLED_OPACITY, RECYCLED_GRADIENT_SHARE = 0.1, 0.1


@dataclass
class GradientDensity(Strategy):
    """Split Gaussians with large gradients along their longest axis; remove transparent and large
    ones.

    Attributes:
        options: The thresholds.
        steps: The length of the schedule.
        scale: The size of the scene (``training.data.known_depths.scene_scale``): the unit of
            thresholds of scales.
        sky: The skybox, which is neither too large nor reset. None without one.
        reset_interval: The number of steps between opacity resets.
    """

    options: GradientExperiments
    steps: int
    scale: float
    sky: Sky | None = None
    timeline: Timeline = field(init=False)
    reset_interval: int = field(init=False)
    observed: GradientStatistics = field(default_factory=GradientStatistics)

    def __post_init__(self) -> None:
        self.timeline = Timeline.of(self.options, self.steps)
        self.reset_interval = max(1, shrunk(self.options.opacity_reset_interval, self.steps))

    @property
    def statistics(self) -> tuple[Tensor, Tensor]:
        return self.observed.gradient_sum, self.observed.seen

    def resets_opacity_after(self, step: int) -> bool:
        """Return True if a whole interval of densification follows, in which opacities recover."""
        interval = self.reset_interval
        return step % interval == 0 and step + interval <= self.timeline.stop

    def prunes_large_after(self, step: int) -> bool:
        """Return True after the first opacity reset (3DGS): until then, large Gaussians (a distant
        background) may not have been split yet. Runs too short for a reset never prune them."""
        resets = 2 * self.reset_interval <= self.timeline.stop
        return resets and self.reset_interval < step and self.timeline.densifies_after(step)

    def start(self, count: int) -> None:
        self.observed.start(count)

    def refine(self, step: DensityStep) -> Refinement:
        """Prune, then split."""
        kept = ~self._useless(step)
        split = torch.zeros_like(kept)
        if self.densifies_after(step.steps):
            gradient = self.observed.mean()
            candidates = kept & (gradient > self.options.grad_threshold) & ~step.frozen
            kept = kept & ~self._recycled(step, kept, gradient, candidates)
            # Each split adds one Gaussian.
            split = highest(gradient, candidates & kept, max(0, step.budget - int(kept.sum())))
        none = torch.zeros_like(kept)
        refinement = multiply(step, kept, cloned=none, split=split, halved=along_longest_axis)
        self.start(len(refinement.rows))
        return refinement

    def reset_opacity(self, geometry: Geometry, frozen: Tensor) -> None:
        limit_opacity(geometry, unlimited=self._sky(geometry, frozen))

    def arrays(self) -> dict[str, NDArray[Any]]:
        return self.observed.arrays()

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        self.observed.restore(arrays)

    def _useless(self, step: DensityStep) -> Tensor:
        """(N,) bool: too transparent, too large, or not finite."""
        geometry = step.geometry
        useless = torch.sigmoid(geometry.opacity_logits) < self.options.prune_opacity
        if any(map(self.prunes_large_after, step.steps)):
            large = longest_scale(geometry) > self.options.prune_scale * self.scale
            useless |= large & ~self._sky(geometry, step.frozen)
        return useless | useless_values(step)

    def _sky(self, geometry: Geometry, frozen: Tensor) -> Tensor:
        if self.sky is None:
            return frozen
        return frozen | torch.from_numpy(self.sky.contains(geometry.means.numpy()))

    def _recycled(
        self, step: DensityStep, kept: Tensor, gradient: Tensor, candidates: Tensor
    ) -> Tensor:
        """(N,) bool: Gaussians that make room for candidates beyond the budget: the most
        transparent of those with the smallest gradients. Without this, the first details would keep
        the whole budget."""
        missing = int(candidates.sum()) - max(0, step.budget - int(kept.sum()))
        limit = min(missing, round(self.options.recycle_share * step.budget))
        count = round(RECYCLED_GRADIENT_SHARE * int(kept.sum()))
        idle = highest(-gradient, kept, count)
        opacity = torch.sigmoid(step.geometry.opacity_logits)
        return highest(-opacity, idle & (opacity < RECYCLED_OPACITY), limit)
