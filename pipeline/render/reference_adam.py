"""Reference implementation of the optimisers in torch, in any float dtype (see ``reference``)."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from pipeline.render.reference import QUAT_NORM2_MIN, rotation_from_quat
from pipeline.render.types import AdamRates, FrameMoments, Moments, ShAdam


def adam_step(param: Tensor, grad: Tensor, moments: Moments, rates: AdamRates) -> None:
    """Adam (Kingma & Ba 2015, algorithm 1), in place."""
    pattern = torch.tensor(rates.rates, dtype=param.dtype)
    repeats = -(-param.numel() // len(pattern))
    lr = pattern.repeat(repeats)[: param.numel()].view(param.shape)
    moments.exp_avg.mul_(rates.beta1).add_(grad, alpha=1 - rates.beta1)
    squares = grad.square()
    if moments.exp_avg_sq.shape != grad.shape:
        squares = squares.mean(1, keepdim=True)
    moments.exp_avg_sq.mul_(rates.beta2).add_(squares, alpha=1 - rates.beta2)
    denominator = moments.exp_avg_sq.sqrt() / math.sqrt(1 - rates.beta2**rates.step) + rates.eps
    param.sub_(lr / (1 - rates.beta1**rates.step) * moments.exp_avg / denominator)


def frame_adam(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    d_means: Tensor,
    d_quats: Tensor,
    moments: FrameMoments,
    rates: AdamRates,
) -> None:
    """Adam over means (N, 3) and quaternions (N, 4) in the local frame of each Gaussian, in place.
    All tensors have the same float type.

    The mean is parametrised as mean = R S y with S = diag(scales); the gradient with respect to y
    is S R^T dL/dmean. In y, the Fisher information of the mean of N(mean, R S S R^T) is the
    identity, so the gradient is the natural gradient (Amari 1998). A quaternion q is updated to
    q (1 + t_x i + t_y j + t_z k), where t are half the rotation angles about the local axes. R, S
    and q are those before the step.
    """
    norm = quats.norm(dim=1, keepdim=True)
    valid = norm.square() >= QUAT_NORM2_MIN
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype)
    unit = torch.where(valid, quats / norm.where(valid, torch.ones_like(norm)), identity)
    frame = rotation_from_quat(unit) * log_scales.exp()[:, None, :]
    w, x, y, z = unit.unbind(1)
    tangents = torch.stack(
        [torch.stack(t, 1) for t in ((-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w))], 2
    )  # (N, 4, 3): q i, q j, q k
    tangents = torch.where(valid[..., None], tangents * norm[..., None], 0.0)
    for param, grad, axes, state, lr in zip(
        (means, quats),
        (d_means, d_quats),
        (frame, tangents),
        (moments.means, moments.rotations),
        rates.rates,
        strict=True,
    ):
        local = torch.zeros_like(state.exp_avg)
        adam_step(local, torch.einsum("nij,ni->nj", axes, grad), state, replace(rates, lr=lr))
        param.add_(torch.einsum("nij,nj->ni", axes, local))


def sh_adam(sh: Tensor, grad: Tensor, updated: Tensor, adam: ShAdam) -> None:
    """Adam over the SH coefficients (N, K, 3) of the Gaussians with a gradient, ``updated`` (N,)
    bool; in place. First moments may have a type of their own, to which they are
    rounded; all other tensors but ``adam.last`` have the type of ``sh``.

    First the n skipped steps with zero gradient are applied: they multiply the moments by beta1^n
    and beta2^n and change the parameter by m / sqrt(v) times r + r^2 + ... + r^n, where
    r = beta1 / sqrt(beta2), with the bias corrections and rates of the current step. Then follows
    an ordinary step.
    """
    rates, exp_avg, exp_avg_sq = adam.rates, adam.moments.exp_avg, adam.moments.exp_avg_sq
    rows = torch.nonzero(updated)[:, 0]
    missed = (rates.step - 1 - adam.last[rows]).to(sh.dtype)[:, None, None]
    lr = torch.full(sh.shape[1:], rates.rates[1], dtype=sh.dtype)
    lr[0] = rates.rates[0]
    lr /= 1 - rates.beta1**rates.step
    scale = math.sqrt(1 - rates.beta2**rates.step)
    ratio = rates.beta1 / math.sqrt(rates.beta2)
    drift = ratio * (1 - ratio**missed) / (1 - ratio)
    g, m, v = grad[rows], exp_avg[rows].to(sh.dtype), exp_avg_sq[rows]
    p = sh[rows] - lr * drift * m / (v.sqrt() / scale + rates.eps)
    m = rates.beta1 ** (missed + 1) * m + (1 - rates.beta1) * g
    v = rates.beta2 ** (missed + 1) * v + (1 - rates.beta2) * g.square().mean(2, keepdim=True)
    sh[rows] = p - lr * m / (v.sqrt() / scale + rates.eps)
    exp_avg[rows], exp_avg_sq[rows] = m.to(exp_avg.dtype), v
    adam.last[rows] = rates.step
