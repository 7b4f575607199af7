"""Losses on the rendered alpha: at masked pixels, of photographs with an alpha channel, and of a
block among its surroundings."""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.render import AlphaChangeLoss
from pipeline.training.data.targets import Target

# Without it a block would fade, since what is behind it often has its colour, and each of two
# blocks on a ray could leave a pixel to the other one.
BLOCK_ALPHA_LOSS = AlphaChangeLoss(weight=1.0, fade=0.02, growth=0.25)


def alpha_gradient(
    alpha: Tensor,
    target: Target,
    mask_loss_weight: float,
    alpha_loss_weight: float,
    squared_error_weight: float,
) -> Tensor | None:
    """(H, W) float32 gradient of the losses on the rendered ``alpha`` (H, W); None without any.

    Args:
        mask_loss_weight: of alpha at ignored pixels (``mask_gradient``).
        alpha_loss_weight, squared_error_weight: of the error at other pixels (``error_gradient``).
    """
    masked = mask_gradient(target, mask_loss_weight)
    error = error_gradient(alpha, target, alpha_loss_weight, squared_error_weight)
    if masked is None or error is None:
        return error if masked is None else masked
    return masked + error


def mask_gradient(target: Target, weight: float) -> Tensor | None:
    """(H, W) float32 gradient of ``weight`` times the sum of alpha over ignored pixels, divided by
    the number of the other pixels; None without ignored pixels or weight, and for overviews of a
    block, whose ignored pixels are not empty."""
    if target.ignored is None or target.is_overview or not weight:
        return None
    counted = target.ignored.numel() - int(target.ignored.sum())
    return target.ignored * (weight / max(1, counted))


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
