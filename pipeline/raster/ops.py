"""The rasterizer's operators. (For now on the torch twin: slow, small sizes only.)"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from pipeline.raster import twin
from pipeline.raster.types import Gradients, LossResult, RasterCamera, RasterOptions, RenderOutput


@dataclass(frozen=True)
class Forward:
    """A drawn view and what ``backward`` needs of it; see RenderOutput for the fields."""

    color: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    median_depth: torch.Tensor
    radii: torch.Tensor
    num_visible: int
    num_dropped: int
    inputs: tuple[torch.Tensor, ...]
    camera: RasterCamera
    options: RasterOptions


def forward(
    means: torch.Tensor,
    log_scales: torch.Tensor,
    quats: torch.Tensor,
    opacity_logits: torch.Tensor,
    sh: torch.Tensor,
    camera: RasterCamera,
    options: RasterOptions,
) -> Forward:
    """Draw a view, without autograd."""
    inputs = tuple(t.detach() for t in (means, log_scales, quats, opacity_logits, sh))
    with torch.no_grad():
        out = twin.render(*inputs, camera, options)  # type: ignore
    return Forward(
        out.color, out.alpha, out.depth, out.median_depth, out.radii, out.num_visible,
        out.num_dropped, inputs, camera, options,
    )  # fmt: skip


def backward(
    fwd: Forward,
    d_color: torch.Tensor,
    d_alpha: torch.Tensor | None = None,
    d_depth: torch.Tensor | None = None,
    *,
    means2d_abs: bool = True,
) -> Gradients:
    """The gradients of a scalar given its gradients on the images."""
    inputs = [t.requires_grad_() for t in (t.clone() for t in fwd.inputs)]
    out = twin.render(*inputs, fwd.camera, fwd.options)  # type: ignore
    total = (out.color * d_color).sum()
    if d_alpha is not None:
        total = total + (out.alpha * d_alpha).sum()
    if d_depth is not None:
        total = total + (out.depth * d_depth).sum()
    grads = torch.autograd.grad(total, inputs, materialize_grads=True)
    flat = torch.zeros(len(inputs[0]), 2)
    return Gradients(*grads, flat, flat.clone() if means2d_abs else None)  # type: ignore


def render(
    means: torch.Tensor,
    log_scales: torch.Tensor,
    quats: torch.Tensor,
    opacity_logits: torch.Tensor,
    sh: torch.Tensor,
    camera: RasterCamera,
    options: RasterOptions,
) -> RenderOutput:
    """Draw a view; color, alpha and depth carry gradients."""
    return twin.render(means, log_scales, quats, opacity_logits, sh, camera, options)


def l1_ssim(
    rendered: torch.Tensor,
    target: torch.Tensor,
    ssim_weight: float,
    mask: torch.Tensor | None = None,
    threads: int = 0,
) -> LossResult:
    """3DGS's loss and its gradient."""
    leaf = rendered.detach().clone().requires_grad_()
    loss, l1, ssim = twin.l1_ssim(leaf, target, ssim_weight, mask)
    (grad,) = torch.autograd.grad(loss, leaf)
    return LossResult(loss.item(), l1.item(), ssim.item(), grad)


def adam_step(
    param: torch.Tensor,
    grad: torch.Tensor,
    exp_avg: torch.Tensor,
    exp_avg_sq: torch.Tensor,
    lr: float,
    step: int,
    beta1: float = 0.9,
    beta2: float = 0.999,
    eps: float = 1e-15,
    threads: int = 0,
) -> None:
    """One step of Adam, in place."""
    twin.adam_step(param, grad, exp_avg, exp_avg_sq, lr, step, beta1, beta2, eps)
