"""The strategy ``original``: density control as published (Kerbl et al. 2023, section 5.2).

The values are those of the authors' implementation (https://github.com/graphdeco-inria/
gaussian-splatting, ``arguments/__init__.py`` and ``scene/gaussian_model.py`` of 2023). Two of its
rules are left out: pruning by size in the image, which has no effect there because the sizes are
cleared before it, and the extra opacity reset with a white background.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.splats.gaussians import Geometry
from pipeline.training.density.growth import (
    GradientStatistics,
    limit_opacity,
    longest_scale,
    multiply,
    sampled,
)
from pipeline.training.density.strategy import (
    DensityStep,
    Refinement,
    Strategy,
    highest,
    useless_values,
)
from pipeline.training.density.timeline import Timeline, shrunk, shrunk_interval

#: densify_from_iter, densify_until_iter (density control takes place before this step),
#: densification_interval and opacity_reset_interval, in steps.
FROM_STEP, UNTIL_STEP, INTERVAL, RESET_INTERVAL = 500, 15_000, 100, 3000
#: densify_grad_threshold, per NDC; percent_dense, the scale above which Gaussians are split rather
#: than cloned, in scene extents.
GRADIENT_THRESHOLD, PERCENT_DENSE = 2e-4, 0.01
#: The thresholds of densify_and_prune: opacity, and scale in scene extents.
MIN_OPACITY, MAX_SCALE = 0.005, 0.1


@dataclass
class OriginalDensity(Strategy):
    """Clone small and split large Gaussians with large gradients; then remove transparent and large
    ones. Nothing is removed after densification.

    Attributes:
        steps: The length of the schedule.
        extent: 3DGS's size of the scene (``scene.views.scene_extent``), world units.
        reset_interval: The number of steps between opacity resets.
    """

    steps: int
    extent: float
    timeline: Timeline = field(init=False)
    reset_interval: int = field(init=False)
    observed: GradientStatistics = field(default_factory=GradientStatistics)

    def __post_init__(self) -> None:
        stop = shrunk(UNTIL_STEP, self.steps) - 1
        self.timeline = Timeline(
            start=shrunk(FROM_STEP, self.steps) + 1,
            stop=stop,
            interval=shrunk_interval(INTERVAL, self.steps),
            prune_stop=stop,
        )
        self.reset_interval = max(1, shrunk(RESET_INTERVAL, self.steps))

    @property
    def statistics(self) -> tuple[Tensor, Tensor]:
        return self.observed.gradient_sum, self.observed.seen

    def resets_opacity_after(self, step: int) -> bool:
        return step % self.reset_interval == 0 and step <= self.timeline.stop

    def prunes_large_after(self, step: int) -> bool:
        return step > self.reset_interval

    def start(self, count: int) -> None:
        self.observed.start(count)

    def refine(self, step: DensityStep) -> Refinement:
        """Split and clone, then prune."""
        every = torch.ones(len(step.geometry), dtype=torch.bool)
        grow = torch.zeros_like(every)
        if self.densifies_after(step.steps):
            gradient = self.observed.mean()
            room = max(0, step.budget - len(step.geometry))
            grow = highest(gradient, gradient >= GRADIENT_THRESHOLD, room)
        large = longest_scale(step.geometry) > PERCENT_DENSE * self.extent
        grown = multiply(
            step,
            every,
            cloned=grow & ~large,
            split=grow & large,
            halved=partial(sampled, rng=step.rng),
        )
        rows = grown.rows
        useless = torch.sigmoid(step.geometry.opacity_logits[rows]) < MIN_OPACITY
        useless |= useless_values(step)[rows]
        for values in grown.values.values():
            useless[grown.changed] |= ~torch.isfinite(values).all(1)
        if any(map(self.prunes_large_after, step.steps)):
            log_scales = grown.array("log_scales", step)
            useless |= log_scales.amax(1).exp() > MAX_SCALE * self.extent
        grown.changes.pruned = int(useless.sum())
        self.start(len(rows) - grown.changes.pruned)
        return grown.select(torch.nonzero(~useless)[:, 0])

    def reset_opacity(self, geometry: Geometry, frozen: Tensor) -> None:
        limit_opacity(geometry)

    def arrays(self) -> dict[str, NDArray[Any]]:
        return self.observed.arrays()

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        self.observed.restore(arrays)
