"""The processor's operators as functions, and rendering with autograd."""

from __future__ import annotations

from typing import Any

import torch

from pipeline.render.registry import make_backend
from pipeline.render.types import RasterCamera, RasterOptions, RenderOutput

_backend = make_backend("cpu")
forward, backward, l1_ssim = _backend.forward, _backend.backward, _backend.l1_ssim
adam_step, frame_adam = _backend.adam_step, _backend.frame_adam


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, camera: RasterCamera, options: RasterOptions, *inputs: Any) -> Any:
        means, log_scales, quats, opacity_logits, sh = inputs
        fwd = forward(means, log_scales, quats, opacity_logits, sh, camera, options)
        ctx.fwd = fwd
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(fwd.median_depth, fwd.radii)
        # Copies: the caller may write to them, and backward reads the originals.
        color, alpha, depth = fwd.color.clone(), fwd.alpha.clone(), fwd.depth.clone()
        return color, alpha, depth, fwd.median_depth, fwd.radii, fwd.num_visible, fwd.num_dropped

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        d_color, d_alpha, d_depth = grads[:3]
        if d_color is None:
            d_color = torch.zeros_like(ctx.fwd.color)
        g = backward(ctx.fwd, d_color, d_alpha, d_depth)
        return None, None, g.means, g.log_scales, g.quats, g.opacity_logits, g.sh


def render(
    means: torch.Tensor,
    log_scales: torch.Tensor,
    quats: torch.Tensor,
    opacity_logits: torch.Tensor,
    sh: torch.Tensor,
    camera: RasterCamera,
    options: RasterOptions,
) -> RenderOutput:
    """Render a view; color, alpha and depth are differentiable with respect to the five tensors.
    See ``Backend.forward``."""
    outputs = _Render.apply(camera, options, means, log_scales, quats, opacity_logits, sh)
    return RenderOutput(*outputs)
