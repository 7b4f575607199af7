"""The loss on the rendered colours: L1, squared error and D-SSIM (Kerbl et al. 2023, eq. 7)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from pipeline.render import Backend, Forward
from pipeline.training.data.step_view import StepView
from pipeline.training.data.targets import psnr_of
from pipeline.training.losses.alpha import BLOCK_ALPHA_LOSS


@dataclass(frozen=True)
class ColorGradients:
    """The loss of a view, and its gradients.

    Attributes:
        d_color: (H, W, 3) gradient with respect to the rendered colours.
        d_alpha: (H, W) gradient with respect to alpha, for a block among its surroundings.
        psnr: The PSNR in dB.
    """

    loss: float
    d_color: Tensor
    d_alpha: Tensor | None
    psnr: float


@dataclass(frozen=True)
class ColorLoss:
    """The loss on colours of a run.

    Attributes:
        ssim_weight, squared_error_weight: See ``Backend.l1_ssim``.
        light_factor: The factor of a view's render (``Inputs.light_factor``).
    """

    ssim_weight: float
    squared_error_weight: float
    light_factor: Callable[[int, int], Tensor | None]
    backend: Backend
    threads: int

    def gradients(self, rendered: Forward, view: StepView) -> ColorGradients:
        """Compare a render with its photograph."""
        target, around = view.target, view.target.surroundings
        color = rendered.color
        if around is not None:
            color = self.backend.compose(around, color, rendered.alpha, self.threads)
        loss = self.backend.l1_ssim(
            color,
            target.over(view.background),
            self.ssim_weight,
            target.ignored,
            self.squared_error_weight,
            self.threads,
            factor=self.light_factor(view.index, view.factor),
        )
        d_color, d_alpha = loss.grad, None
        if around is not None:
            d_color, d_alpha = self.backend.compose_backward(
                around, rendered.alpha, d_color, BLOCK_ALPHA_LOSS, self.threads
            )
        return ColorGradients(float(loss.loss), d_color, d_alpha, psnr_of(loss.squared_error))
