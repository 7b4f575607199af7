"""Arguments of ``Backend.update`` for tests."""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.render import AdamRates, FrameMoments, GaussianAdam, Moments, ShAdam
from pipeline.render.checks import Parameters

STEP = 30


def made_adam(parameters: Parameters) -> GaussianAdam:
    """Adam with random moments."""
    means, log_scales, _, opacity_logits, sh = parameters
    draws = torch.Generator().manual_seed(8)

    def moments(like: Tensor) -> Moments:
        first, second = torch.randn(2, *like.shape, generator=draws)
        return Moments(1e-3 * first, 1e-6 * second.square())

    first, second = vars(moments(sh)).values()
    of_sh = Moments(first.bfloat16(), second[..., :1].contiguous())
    last = torch.randint(0, STEP, (len(means),), generator=draws, dtype=torch.int32)
    return GaussianAdam(
        FrameMoments(moments(means), moments(means)), AdamRates((1e-2, 1e-3), STEP),
        moments(log_scales), AdamRates(5e-3, STEP, beta1=0.8),
        moments(opacity_logits), AdamRates(2e-2, STEP, eps=1e-9),
        ShAdam(of_sh, last, AdamRates((1e-2, 1e-3), STEP)),
    )  # fmt: skip


def moments_of(adam: GaussianAdam) -> list[Tensor]:
    """All moments."""
    every = (
        *(adam.frames.means, adam.frames.rotations, adam.log_scales, adam.opacity_logits),
        adam.sh.moments,
    )
    return [tensor for of in every for tensor in (of.exp_avg, of.exp_avg_sq)]
