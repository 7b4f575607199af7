"""The strategy ``original``: density control as published (Kerbl et al. 2023, section 5.2).

The values are those of the authors' implementation (https://github.com/graphdeco-inria/
gaussian-splatting, ``arguments/__init__.py`` and ``scene/gaussian_model.py`` of 2023). Two of its
rules are left out: pruning by size in the image, which has no effect there because the sizes are
cleared before it, and the extra opacity reset with a white background.
"""

from __future__ import annotations

import numpy as np
import torch

from pipeline.config.experiments import GradientExperiments
from pipeline.splats.gaussians import Gaussians
from pipeline.training.density.gradient import GradientDensity, highest
from pipeline.training.density.strategy import Changes
from pipeline.training.density.timeline import Timeline, shrunk, shrunk_interval
from pipeline.training.optimisers.adam import Adam

#: densify_from_iter, densification_interval, densify_grad_threshold, percent_dense, opacity_reset_
#: interval, and the thresholds of densify_and_prune.
PUBLISHED = GradientExperiments(
    start_step=500,
    interval=100,
    grad_threshold=2e-4,
    clone=True,
    split_kind="sampled",
    split_scale=0.01,
    recycle_share=0.0,
    prune_opacity=0.005,
    prune_scale=0.1,
    opacity_reset_interval=3000,
)
#: densify_until_iter: density control takes place before this step.
UNTIL_STEP = 15_000


class OriginalDensity(GradientDensity):
    """Clone small and split large Gaussians with large gradients; then remove transparent and large
    ones. Nothing is removed after densification."""

    def __init__(self, steps: int, extent: float):
        super().__init__(PUBLISHED, steps, extent)
        stop = shrunk(UNTIL_STEP, steps) - 1
        self.timeline = Timeline(
            start=shrunk(PUBLISHED.start_step, steps) + 1,
            stop=stop,
            interval=shrunk_interval(PUBLISHED.interval, steps),
            prune_stop=stop,
        )

    def resets_opacity_after(self, step: int) -> bool:
        return step % self.reset_interval == 0 and step <= self.timeline.stop

    def prunes_large_after(self, step: int) -> bool:
        return step > self.reset_interval

    def refine(
        self,
        gaussians: Gaussians,
        adam: Adam,
        rng: np.random.Generator,
        *,
        densify: bool,
        prune_large: bool,
        budget: int,
    ) -> tuple[Gaussians, Changes]:
        """(``densify``) Split and clone, then prune."""
        kept = torch.ones(len(gaussians), dtype=torch.bool)
        grow = torch.zeros_like(kept)
        if densify:
            gradient = self.mean_gradient()
            room = max(0, budget - len(gaussians))
            grow = highest(gradient, gradient >= self.options.grad_threshold, room)
        gaussians, changes = self.multiply(gaussians, adam, rng, kept, grow)
        alive = torch.nonzero(~self.useless(gaussians, prune_large))[:, 0]
        changes.pruned = len(gaussians) - len(alive)
        adam.select(alive, torch.zeros(len(alive), dtype=torch.bool))
        self.start(len(alive))
        return gaussians.select(alive), changes
