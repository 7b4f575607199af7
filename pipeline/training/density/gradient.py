"""The strategy ``gradient``: density control after Kerbl et al. 2023, section 5.2, with a budget.

Gaussians with large gradients of their projected centres are split (or cloned), the largest
gradients first; transparent and large ones are removed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.config.experiments import GradientExperiments
from pipeline.render import Forward, Gradients
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.skybox import Sky
from pipeline.training.density.strategy import Changes, Strategy, not_finite, rotations
from pipeline.training.density.timeline import Timeline, shrunk
from pipeline.training.optimisers.adam import Adam

# A sampled split divides the scales by 0.8 N with N = 2 (3DGS).
SPLIT_SHRINK = 1.6
# A split along the longest axis (after Deng et al. 2025): factors of the scale along it, of the
# other scales and of the opacity. The offset of the halves keeps the variance along the axis.
LONG_AXIS, OTHER_AXES, HALVES_OPACITY = 0.5, 0.85, 0.8
LONG_OFFSET = math.sqrt(1 - LONG_AXIS**2)
RESET_OPACITY = 0.01
# Only Gaussians below this opacity are recycled, and only those among this share with the smallest
# gradients: new Gaussians are transparent as well, but have large gradients.
RECYCLED_OPACITY, RECYCLED_GRADIENT_SHARE = 0.1, 0.1


@dataclass
class GradientDensity(Strategy):
    """Split (or clone) Gaussians with large gradients; remove transparent and large ones.

    Attributes:
        options: thresholds.
        steps: length of the schedule.
        scale: size of the scene (``training.data.known_depths.scene_scale``): the unit of
            thresholds of scales.
        sky: is neither too large nor reset. None without a skybox.
        reset_interval: steps between opacity resets.
        gradient_sum: (N,) float32, sum of the norms of the gradients of the projected centres, in
            normalised device coordinates (independent of the resolution).
        seen: (N,) float32, number of steps in which the Gaussian was visible.
    """

    options: GradientExperiments
    steps: int
    scale: float
    sky: Sky | None = None
    timeline: Timeline = field(init=False)
    reset_interval: int = field(init=False)
    gradient_sum: Tensor = field(default_factory=lambda: torch.zeros(0))
    seen: Tensor = field(default_factory=lambda: torch.zeros(0))

    def __post_init__(self) -> None:
        self.timeline = Timeline.of(self.options, self.steps)
        self.reset_interval = max(1, shrunk(self.options.opacity_reset_interval, self.steps))

    @property
    def statistics(self) -> tuple[Tensor, Tensor]:
        return self.gradient_sum, self.seen

    @property
    def needs_absolute_gradients(self) -> bool:
        return self.options.absolute_gradient

    def resets_opacity_after(self, step: int) -> bool:
        """Only if a whole interval of densification follows, in which opacities recover."""
        interval = self.reset_interval
        return step % interval == 0 and step + interval <= self.timeline.stop

    def prunes_large_after(self, step: int) -> bool:
        """After the first opacity reset (3DGS): until then, large Gaussians (a distant background)
        may not have been split yet. Never in runs too short for a reset."""
        resets = 2 * self.reset_interval <= self.timeline.stop
        return resets and self.reset_interval < step and self.timeline.densifies_after(step)

    def start(self, count: int) -> None:
        self.gradient_sum, self.seen = torch.zeros(count), torch.zeros(count)

    def observe(self, rendered: Forward, gradients: Gradients) -> None:
        gradient = gradients.means2d
        if self.options.absolute_gradient:
            assert gradients.means2d_abs is not None
            gradient = gradients.means2d_abs
        height, width = rendered.alpha.shape
        # Pixels to normalised device coordinates: x_ndc = 2 x / width - 1.
        self.gradient_sum += torch.hypot(
            gradient[:, 0] * (0.5 * width), gradient[:, 1] * (0.5 * height)
        )
        self.seen += rendered.radii > 0

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
        """Prune, then (``densify``) split and clone."""
        kept = ~self.useless(gaussians, prune_large)
        grow = torch.zeros_like(kept)
        if densify:
            gradient = self.mean_gradient()
            candidates = kept & (gradient > self.options.grad_threshold)
            kept = kept & ~self._recycled(gaussians, kept, gradient, candidates, budget)
            # Each adds one Gaussian, cloned or split.
            grow = highest(gradient, candidates & kept, max(0, budget - int(kept.sum())))
        return self.multiply(gaussians, adam, rng, kept, grow)

    def mean_gradient(self) -> Tensor:
        """(N,) mean norm of the gradient over the steps in which the Gaussian was visible."""
        return self.gradient_sum / self.seen.clamp(min=1.0)

    def multiply(
        self,
        gaussians: Gaussians,
        adam: Adam,
        rng: np.random.Generator,
        kept: Tensor,
        grow: Tensor,
    ) -> tuple[Gaussians, Changes]:
        """Remove all but ``kept`` and split or clone ``grow`` (N,) bool. Statistics start anew."""
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
            if self.options.split_kind == "long_axis":
                _halve(result, children)
            else:
                result.means[children] += _offsets(result, children, rng)
                result.log_scales[children] -= math.log(SPLIT_SHRINK)
        self.start(len(result))
        return result, changes

    def reset_opacity(self, gaussians: Gaussians, adam: Adam) -> None:
        """Limit every opacity to ``RESET_OPACITY``; those of useful Gaussians recover."""
        limit = torch.full_like(gaussians.opacity_logits, math.inf)
        limit[~self._sky(gaussians)] = math.log(RESET_OPACITY / (1 - RESET_OPACITY))
        torch.minimum(gaussians.opacity_logits, limit, out=gaussians.opacity_logits)
        adam.forget("opacity_logits")

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"gradient_sum": self.gradient_sum.numpy(), "seen": self.seen.numpy()}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        self.gradient_sum = torch.from_numpy(arrays["gradient_sum"])
        self.seen = torch.from_numpy(arrays["seen"])

    def useless(self, gaussians: Gaussians, prune_large: bool) -> Tensor:
        """(N,) bool: too transparent, too large (``prune_large``), or not finite."""
        useless = torch.sigmoid(gaussians.opacity_logits) < self.options.prune_opacity
        if prune_large:
            large = self._longest(gaussians) > self.options.prune_scale * self.scale
            useless |= large & ~self._sky(gaussians)
        return useless | not_finite(gaussians)

    def _sky(self, gaussians: Gaussians) -> Tensor:
        if self.sky is None:
            return torch.zeros(len(gaussians), dtype=torch.bool)
        return torch.from_numpy(self.sky.contains(gaussians.means.numpy()))

    def _large(self, gaussians: Gaussians) -> Tensor:
        """(N,) bool: Gaussians that are split rather than cloned."""
        if not (self.options.clone and self.options.split):
            return torch.full((len(gaussians),), self.options.split)
        return self._longest(gaussians) > self.options.split_scale * self.scale

    def _recycled(
        self, gaussians: Gaussians, kept: Tensor, gradient: Tensor, candidates: Tensor, budget: int
    ) -> Tensor:
        """(N,) bool: Gaussians that make room for candidates beyond the budget: the most
        transparent of those with the smallest gradients. Without this, the first details would keep
        the whole budget."""
        missing = int(candidates.sum()) - max(0, budget - int(kept.sum()))
        limit = min(missing, round(self.options.recycle_share * budget))
        count = round(RECYCLED_GRADIENT_SHARE * int(kept.sum()))
        idle = highest(-gradient, kept, count)
        opacity = torch.sigmoid(gaussians.opacity_logits)
        return highest(-opacity, idle & (opacity < RECYCLED_OPACITY), limit)

    @staticmethod
    def _longest(gaussians: Gaussians) -> Tensor:
        return gaussians.log_scales.amax(1).exp()


def highest(score: Tensor, among: Tensor, count: int) -> Tensor:
    """(N,) bool: rows with the ``count`` highest scores ``among`` (N,) bool, the first of ties."""
    if int(among.sum()) <= count:
        return among
    chosen = torch.zeros_like(among)
    if count > 0:
        lowest = torch.full_like(score, -math.inf)
        order = torch.argsort(score.where(among, lowest), descending=True, stable=True)
        chosen[order[:count]] = True
    return chosen


def _halve(gaussians: Gaussians, rows: slice) -> None:
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


def _offsets(gaussians: Gaussians, rows: slice, rng: np.random.Generator) -> Tensor:
    """(M, 3) draws from each Gaussian of ``rows`` about its mean."""
    scales = gaussians.log_scales[rows].exp()
    noise = torch.from_numpy(rng.standard_normal(scales.shape, np.float32))
    return torch.einsum("nij,nj->ni", rotations(gaussians.quats[rows]), scales * noise)
