"""Losses on the rendered alpha: at masked pixels, of photographs with an alpha channel, and of a
block among its surroundings."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pipeline.render import AlphaChangeLoss
from pipeline.render.resident import Planes
from pipeline.training.data.step_view import StepView
from pipeline.training.data.targets import Target
from pipeline.training.losses.plane import PlaneGradients, add

# Without this loss, a block would fade, since what is behind it often has its colour, and each of
# two blocks on a ray could leave a pixel to the other one.
BLOCK_ALPHA_LOSS = AlphaChangeLoss(weight=1.0, fade=0.02, growth=0.25)


@dataclass(frozen=True)
class AlphaLoss:
    """The losses on the rendered alpha of a view.

    Attributes:
        mask_loss_weight: The weight of alpha at ignored pixels (``mask_gradient``).
        alpha_loss_weight, squared_error_weight: The weights of the error at other pixels
            (``error_gradient``).
    """

    mask_loss_weight: float
    alpha_loss_weight: float
    squared_error_weight: float

    def is_due(self, view: StepView, step: int) -> bool:
        target = view.target
        masked = target.ignored is not None and self.mask_loss_weight > 0
        return masked or (target.alpha is not None and self.alpha_loss_weight > 0)

    def gradients(self, rendered: Planes, view: StepView) -> PlaneGradients:
        masked = mask_gradient(view.target, self.mask_loss_weight)
        error = error_gradient(
            rendered.alpha, view.target, self.alpha_loss_weight, self.squared_error_weight
        )
        return PlaneGradients(alpha=add(masked, error))


def mask_gradient(target: Target, weight: float) -> Tensor | None:
    """(H, W) float32 gradient of ``weight`` times the sum of alpha over ignored pixels, divided by
    the number of the other pixels; None without ignored pixels or weight, and for overviews of a
    block, whose ignored pixels are not empty. Nor are those that transients hide."""
    if target.ignored is None or target.is_overview or not weight:
        return None
    counted = target.ignored.numel() - int(target.ignored.sum())
    empty = target.ignored if target.transient is None else target.ignored & ~target.transient
    return empty * (weight / max(1, counted))


def error_gradient(
    alpha: Tensor, target: Target, weight: float, squared_error_weight: float
) -> Tensor | None:
    """(H, W) float32 gradient of ``weight`` times the mean of |d| + ``squared_error_weight`` d^2
    over pixels that are not ignored, d being the rendered ``alpha`` minus the photograph's; None
    for an opaque photograph or without weight. It has the effect of random backgrounds, without
    their noise."""
    if target.alpha is None or not weight:
        return None
    error = alpha - target.alpha.to(torch.float32) / 255.0
    counted = error.numel()
    if target.ignored is not None:
        error = error.masked_fill(target.ignored, 0.0)
        counted -= int(target.ignored.sum())
    return (weight / max(1, counted)) * (error.sign() + 2 * squared_error_weight * error)
