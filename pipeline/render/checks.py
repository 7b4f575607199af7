"""Checks of a backend's inputs: types, shapes and cameras; they raise ``ValueError``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain

import torch
from torch import Tensor

from pipeline.render.types import (
    AdamRates,
    FrameMoments,
    GaussianAdam,
    Moments,
    RasterCamera,
    ShAdam,
    Surroundings,
)

MAX_IMAGE_SIDE = 1 << 16

Parameters = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""means (N, 3), log_scales (N, 3), quats (N, 4), opacity_logits (N,), sh (N, K, 3)."""


def checked(name: str, value: Tensor, shape: tuple[int | None, ...]) -> Tensor:
    """The tensor, detached and contiguous.

    Raises:
        ValueError: not float32 on the CPU, or not of this shape (None: any size).
    """
    found = value.shape
    fits = len(found) == len(shape) and all(
        [wanted is None or wanted == size for wanted, size in zip(shape, found, strict=True)]
    )
    if value.dtype != torch.float32 or not value.is_cpu or not fits:
        raise ValueError(
            f"{name}: expected float32 {tuple('any' if s is None else s for s in shape)} on the "
            f"CPU, found {value.dtype} {tuple(value.shape)} on {value.device}"
        )
    return (value.detach() if value.requires_grad else value).contiguous()


def parameters(
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    opacity_logits: Tensor,
    sh: Tensor,
    degree: int,
) -> Parameters:
    """The parameters of Gaussians, checked, with SH coefficients up to ``degree``."""
    n = means.shape[0]
    if not 0 <= degree <= 3 or sh.dim() != 3 or sh.shape[1] < (degree + 1) ** 2:
        raise ValueError(f"sh_degree {degree} does not fit sh of shape {tuple(sh.shape)}")
    return (
        checked("means", means, (n, 3)),
        checked("log_scales", log_scales, (n, 3)),
        checked("quats", quats, (n, 4)),
        checked("opacity_logits", opacity_logits, (n,)),
        checked("sh", sh, (n, None, 3)),
    )


def check_camera(camera: RasterCamera, near: float) -> None:
    """Raise ValueError if the camera is invalid."""
    pose = camera.world_to_camera
    if pose.shape != (4, 4):
        raise ValueError(f"world_to_camera: expected (4, 4), found {tuple(pose.shape)}")
    values = [camera.fx, camera.fy, camera.cx, camera.cy, near, *chain(*pose.tolist()[:3])]
    if not all(map(math.isfinite, values)):
        raise ValueError("camera: every value must be finite")
    if not (camera.fx > 0 and camera.fy > 0):
        raise ValueError(f"camera: focal lengths must be positive, found {camera.fx}, {camera.fy}")
    if not (1 <= camera.width <= MAX_IMAGE_SIDE and 1 <= camera.height <= MAX_IMAGE_SIDE):
        raise ValueError(
            f"camera: {camera.width} x {camera.height} px, sides must be 1 to {MAX_IMAGE_SIDE}"
        )
    if not near > 0:
        raise ValueError(f"near must be positive, found {near}")


def image_gradients(
    d_color: Tensor, d_alpha: Tensor | None, d_depth: Tensor | None, size: tuple[int, int]
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Gradients on the images of a view of ``size`` (width, height), checked by ``checked``."""
    width, height = size
    return (
        checked("d_color", d_color, (height, width, 3)),
        None if d_alpha is None else checked("d_alpha", d_alpha, (height, width)),
        None if d_depth is None else checked("d_depth", d_depth, (height, width)),
    )


def images(
    rendered: Tensor, target: Tensor, mask: Tensor | None, factor: Tensor | None
) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
    """The images of a loss, checked: rendered (H, W, 3), target float32 or uint8, mask uint8, and
    the factor of the rendered image."""
    rendered = checked("rendered", rendered, (None, None, 3))
    size = tuple(rendered.shape)
    if target.dtype == torch.uint8 and tuple(target.shape) == size:
        target = target.contiguous()
    else:
        target = checked("target", target, size)
    if mask is not None:
        if mask.dtype not in (torch.bool, torch.uint8) or tuple(mask.shape) != size[:2]:
            raise ValueError(
                f"mask: expected bool or uint8 {size[:2]}, found {mask.dtype} {tuple(mask.shape)}"
            )
        mask = mask.contiguous().view(torch.uint8)
    if factor is not None:
        factor = checked("factor", factor, (3,) if factor.dim() == 1 else size)
    return rendered, target, mask, factor


def layers(around: Surroundings, color: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """(H, W, 3) and (H, W) images of a part of a scene that fit its surroundings, checked."""
    color = checked("color", color, (None, None, 3))
    height, width = color.shape[:2]
    expected = {
        "behind": (torch.uint8, (height, width, 3)),
        "alpha": (torch.uint8, (height, width)),
        "front": (torch.uint8, (height, width, 3)),
        "transmittance": (torch.uint8, (height, width)),
        "correction": (torch.int8, (height, width, 3)),
    }
    for name, (dtype, shape) in expected.items():
        plane = getattr(around, name)
        if plane is None and name not in ("behind", "alpha"):
            continue
        if plane.dtype != dtype or plane.shape != shape or not plane.is_contiguous():
            raise ValueError(
                f"{name}: expected contiguous {dtype} {shape}, found {plane.dtype} "
                f"{tuple(plane.shape)}"
            )
    if (around.front is None) != (around.transmittance is None):
        raise ValueError("front and transmittance: expected both or neither")
    return color, checked("alpha", alpha, (height, width))


def check_sh_adam(adam: ShAdam, sh: Tensor) -> None:
    """Raise ValueError if the moments do not fit ``sh`` or the rates are invalid."""
    count, bands, _ = sh.shape
    for tensor, dtype, shape in (
        (adam.moments.exp_avg, torch.bfloat16, (count, bands, 3)),
        (adam.moments.exp_avg_sq, torch.float32, (count, bands, 1)),
    ):
        if tensor.dtype != dtype or tensor.shape != shape or not tensor.is_contiguous():
            raise ValueError(
                f"sh_adam: moments: expected contiguous {dtype} {shape}, found {tensor.dtype} "
                f"{tuple(tensor.shape)}"
            )
    if adam.last.dtype != torch.int32 or adam.last.shape != sh.shape[:1]:
        raise ValueError(f"sh_adam: last must be int32 of shape ({len(sh)},)")
    _check_rates("sh_adam", adam.rates, count=2)


def check_adam(param: Tensor, grad: Tensor, moments: Moments, rates: AdamRates) -> None:
    """Raise ValueError if the arguments of ``adam_step`` are invalid."""
    second = moments.exp_avg_sq
    shared = tuple(second.shape) == (len(param), 1) and tuple(param.shape[1:]) in ((3,), (4,))
    for tensor in (param, grad, moments.exp_avg, second):
        if tensor.dtype != torch.float32 or not tensor.is_contiguous():
            raise ValueError("adam_step: tensors must be float32 and contiguous")
        if tensor.shape != param.shape and not (shared and tensor is second):
            raise ValueError(f"adam_step: shapes differ, {param.shape} and {tensor.shape}")
    if shared and not isinstance(rates.lr, int | float):
        raise ValueError(f"adam_step: rows that share a moment have one lr, found {rates.lr}")
    _check_rates("adam_step", rates)


def check_frame_adam(
    parameters: tuple[Tensor, Tensor, Tensor],
    gradients: tuple[Tensor, Tensor],
    moments: FrameMoments,
    rates: AdamRates,
) -> None:
    """Raise ValueError if the arguments of ``frame_adam`` are invalid: means, quaternions and log
    scales; the gradients of the first two; and their moments."""
    (means, quats, log_scales), (d_means, d_quats) = parameters, gradients
    threes = [means, log_scales, d_means, *vars(moments.means).values()]
    threes += vars(moments.rotations).values()
    for width, tensors in ((3, threes), (4, [quats, d_quats])):
        shape = (means.shape[0], width)
        for tensor in tensors:
            if tensor.dtype != torch.float32 or not tensor.is_contiguous():
                raise ValueError("frame_adam: tensors must be float32 and contiguous")
            if tensor.shape != shape:
                raise ValueError(f"frame_adam: expected {shape}, found {tuple(tensor.shape)}")
    _check_rates("frame_adam", rates, count=2)


def check_update(
    parameters: Parameters,
    adam: GaussianAdam,
    statistics: tuple[Tensor, Tensor] | None,
    count: int,
) -> None:
    """Raise ValueError if the arguments of ``update`` for ``count`` Gaussians do not fit each other
    or are invalid."""
    means, log_scales, quats, opacity_logits, sh = parameters
    for tensor, shape in ((means, (count, 3)), (sh, (count, None, 3))):
        if checked("parameters", tensor, shape).data_ptr() != tensor.data_ptr():
            raise ValueError("update: parameters must be contiguous")
    for tensor in statistics or ():
        if checked("statistics", tensor, (count,)).data_ptr() != tensor.data_ptr():
            raise ValueError("update: statistics must be contiguous")
    check_frame_adam((means, quats, log_scales), (means, quats), adam.frames, adam.frame_rates)
    for parameter, moments, rates in (
        (log_scales, adam.log_scales, adam.log_scale_rates),
        (opacity_logits, adam.opacity_logits, adam.opacity_rates),
    ):
        check_adam(parameter, parameter, moments, rates)
        if len(rates.rates) != 1 or moments.exp_avg_sq.shape != parameter.shape:
            raise ValueError("update: scales and opacities have one rate and moments of their own")
    check_sh_adam(adam.sh, sh)


def check_rows(tensors: Sequence[Tensor], rows: Tensor, zeroed: Tensor | None) -> None:
    """Raise ValueError if the arguments of ``take_rows`` do not fit, and IndexError if an
    index is out of range."""
    counts = {len(tensor) for tensor in tensors}
    if len(counts) > 1 or not all(t.is_contiguous() and t.is_cpu for t in tensors):
        raise ValueError("take_rows: tensors must be contiguous and have as many rows each")
    if rows.dtype != torch.int64 or rows.dim() != 1 or not rows.is_contiguous():
        raise ValueError(f"take_rows: rows must be int64 (M,), found {rows.dtype}")
    if zeroed is not None and (zeroed.dtype != torch.bool or zeroed.shape != rows.shape):
        raise ValueError("take_rows: zeroed must be bool, one for each of the rows")
    if zeroed is not None and not zeroed.is_contiguous():
        raise ValueError("take_rows: zeroed must be contiguous")
    if tensors and len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < len(tensors[0]):
        raise IndexError("take_rows: a row is out of range")


def _check_rates(operator: str, rates: AdamRates, count: int | None = None) -> None:
    if rates.step < 1 or not all(
        map(math.isfinite, (*rates.rates, rates.beta1, rates.beta2, rates.eps))
    ):
        raise ValueError(
            f"{operator}: step {rates.step} must be at least 1 and lr {rates.lr} finite"
        )
    if len(rates.rates) != count and (count is not None or not rates.rates):
        raise ValueError(f"{operator}: expected {count or 'any'} rates, found {rates.lr}")
