"""The rasterizer's operators on the C++ kernels. float32, contiguous, CPU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from pipeline.render.cpu import build
from pipeline.render.types import (
    CameraGradients,
    FrameAdam,
    Gradients,
    LossResult,
    RasterCamera,
    RasterOptions,
    RenderOutput,
    ShAdam,
)
from pipeline.runtime.errors import UserError

MAX_IMAGE_SIDE = 1 << 16


@dataclass(frozen=True)
class Forward:
    """A drawn view and what ``backward`` needs of it. Do not write to its tensors.

    Attributes:
        color: (H, W, 3) float32, the background included.
        alpha: (H, W) float32, 1 - transmittance.
        depth: (H, W) float32, sum of weight * camera z, not divided by alpha. Drawn when first
            asked for, as median_depth is: a training step that looks at neither pays for neither.
        median_depth: (H, W) float32, camera z of the Gaussian that takes the transmittance below
            0.5; 0 where none does.
        radii: (N,) float32 pixels along the long axis out to where alpha falls to 1/255;
            0: not visible.
        num_visible: Gaussians that touch the image.
        num_dropped: Gaussians left out because a value is not finite or degenerate.
        num_intersections: (Gaussian, tile) pairs, what memory and time go with.
    """

    color: torch.Tensor
    alpha: torch.Tensor
    radii: torch.Tensor
    num_visible: int
    num_dropped: int
    state: _State

    @property
    def num_intersections(self) -> int:
        return self.state.entries.shape[0]

    @cached_property
    def _depths(self) -> tuple[torch.Tensor, torch.Tensor]:
        s = self.state
        return _ops().blend_depth(
            s.records, s.entries, s.tile_begin, s.view, *s.size, _threads(s.options.threads)
        )

    @property
    def depth(self) -> torch.Tensor:
        return self._depths[0]

    @property
    def median_depth(self) -> torch.Tensor:
        return self._depths[1]


@dataclass(frozen=True)
class _State:
    """The kernels' values between forward and backward; layouts in csrc/types.h."""

    inputs: tuple[torch.Tensor, ...]  # means, log_scales, quats, opacity_logits, sh
    view: torch.Tensor  # (17,) float64
    size: tuple[int, int]  # width, height
    background: torch.Tensor  # (3,)
    options: RasterOptions
    records: torch.Tensor  # (N, 16)
    entries: torch.Tensor  # (M, 3) int32
    tile_begin: torch.Tensor  # (tiles + 1,) int64
    block_end: torch.Tensor  # (tiles, blocks of a tile) int32
    slots: torch.Tensor  # (N, 2) int32


def _ops() -> Any:
    build.load()
    return torch.ops.splatmake


def _threads(threads: int) -> int:
    return threads if threads > 0 else torch.get_num_threads()


def _plain(name: str, value: torch.Tensor, shape: tuple[int | None, ...]) -> torch.Tensor:
    """The tensor detached, after a look at its type and shape (None: any size)."""
    fits = value.dim() == len(shape) and all(
        want is None or want == have for want, have in zip(shape, value.shape, strict=True)
    )
    if value.dtype != torch.float32 or value.device.type != "cpu" or not fits:
        raise ValueError(
            f"{name}: expected float32 {tuple('any' if s is None else s for s in shape)} on the "
            f"CPU, found {value.dtype} {tuple(value.shape)} on {value.device}"
        )
    return value.detach().contiguous()


def _pack_view(camera: RasterCamera, near: float) -> torch.Tensor:
    """(17,) float64: fx fy cx cy, rotation by rows, translation, near."""
    pose = camera.world_to_camera.detach().double()
    if pose.shape != (4, 4):
        raise ValueError(f"world_to_camera: expected (4, 4), found {tuple(pose.shape)}")
    head = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
    tail = torch.tensor([near], dtype=torch.float64)
    view = torch.cat([head, pose[:3, :3].reshape(-1), pose[:3, 3], tail])
    if not bool(view.isfinite().all()):
        raise ValueError("camera: every value must be finite")
    if not (camera.fx > 0 and camera.fy > 0):
        raise ValueError(f"camera: focal lengths must be positive, found {camera.fx}, {camera.fy}")
    if not (1 <= camera.width <= MAX_IMAGE_SIDE and 1 <= camera.height <= MAX_IMAGE_SIDE):
        raise ValueError(
            f"camera: {camera.width} x {camera.height} px, sides must be 1 to {MAX_IMAGE_SIDE}"
        )
    if not near > 0:
        raise ValueError(f"near must be positive, found {near}")
    return view


def forward(
    means: torch.Tensor,
    log_scales: torch.Tensor,
    quats: torch.Tensor,
    opacity_logits: torch.Tensor,
    sh: torch.Tensor,
    camera: RasterCamera,
    options: RasterOptions,
) -> Forward:
    """Draw a view, without autograd.

    Args:
        means: (N, 3) float32, world.
        log_scales: (N, 3) float32.
        quats: (N, 4) float32 wxyz, of any length.
        opacity_logits: (N,) float32.
        sh: (N, K, 3) float32, K >= (options.sh_degree + 1)^2.

    Raises:
        ValueError: shapes or types that do not fit, a camera that is none.
        UserError: more (Gaussian, tile) pairs than memory is meant for; no compiler.
    """
    n, degree = means.shape[0], options.sh_degree
    if not 0 <= degree <= 3 or sh.dim() != 3 or sh.shape[1] < (degree + 1) ** 2:
        raise ValueError(f"sh_degree {degree} does not fit sh of shape {tuple(sh.shape)}")
    inputs = (
        _plain("means", means, (n, 3)),
        _plain("log_scales", log_scales, (n, 3)),
        _plain("quats", quats, (n, 4)),
        _plain("opacity_logits", opacity_logits, (n,)),
        _plain("sh", sh, (n, None, 3)),
    )
    view, size = _pack_view(camera, options.near), (camera.width, camera.height)
    background = torch.tensor(options.background or (0.0, 0.0, 0.0), dtype=torch.float32)
    ops, threads = _ops(), _threads(options.threads)
    records, radii, visible, dropped = ops.project(
        *inputs, view, *size, degree, options.antialias, threads
    )
    entries, tile_begin, slots, fits = ops.bin(records, radii, view, *size, threads)
    if not fits:
        raise UserError(
            f"{visible} Gaussians cover more than 2^27 image tiles of 16 x 16 pixels in one view",
            fix="draw smaller images, or look for Gaussians grown far too large",
        )
    color, alpha, block_end = ops.blend(
        records, entries, tile_begin, view, *size, background, threads
    )
    state = _State(
        inputs, view, size, background, options, records, entries, tile_begin, block_end, slots
    )
    return Forward(color, alpha, radii, visible, dropped, state)


def backward(
    fwd: Forward,
    d_color: torch.Tensor,
    d_alpha: torch.Tensor | None = None,
    d_depth: torch.Tensor | None = None,
    *,
    means2d_abs: bool = True,
    camera: bool = False,
    sh_adam: ShAdam | None = None,
) -> Gradients:
    """The gradients of a scalar, given its gradients on the images.

    Args:
        d_color: (H, W, 3) float32; d_alpha, d_depth: (H, W) float32 or None.
        means2d_abs: sum absolute values too; about a fifth of the time.
        camera: give the camera's gradients, too.
        sh_adam: move the harmonics of the Gaussians in view by Adam at once, in place, instead
            of giving their gradients: those are four fifths of all, and would only be written
            to be read again.
    """
    s = fwd.state
    width, height = s.size
    d_color = _plain("d_color", d_color, (height, width, 3))
    if d_alpha is not None:
        d_alpha = _plain("d_alpha", d_alpha, (height, width))
    if d_depth is not None:
        d_depth = _plain("d_depth", d_depth, (height, width))
    ops, threads = _ops(), _threads(s.options.threads)
    slot_gradients = ops.blend_backward(
        s.records, s.entries, s.tile_begin, s.block_end, s.view, width, height, s.background,
        fwd.color, fwd.alpha, None if d_depth is None else fwd.depth, d_color, d_alpha, d_depth,
        means2d_abs, s.options.gradients_per_pixel, threads,
    )  # fmt: skip
    d_means, d_scales, d_quats, d_opacity, d_sh, d_means2d, d_abs, d_camera = ops.project_backward(
        *s.inputs, s.view, width, height, s.options.sh_degree, s.options.antialias, s.records,
        fwd.radii, s.slots, slot_gradients, s.options.black_stays, means2d_abs, camera,
        *_moments(sh_adam, s.inputs[4]),
        threads,
    )  # fmt: skip
    parts = d_camera.split([3, 3, 2, 2]) if camera else None
    return Gradients(
        d_means, d_scales, d_quats, d_opacity, d_sh, d_means2d, d_abs if means2d_abs else None,
        None if parts is None else CameraGradients(*parts),
    )  # fmt: skip


def _moments(adam: ShAdam | None, sh: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    if adam is None:
        return None, None, None, None
    for tensor in (adam.exp_avg, adam.exp_avg_sq):
        if tensor.dtype != torch.float32 or tensor.shape != sh.shape or not tensor.is_contiguous():
            raise ValueError("sh_adam: moments must be float32, contiguous and shaped as sh")
    if adam.last.dtype != torch.int32 or adam.last.shape != sh.shape[:1]:
        raise ValueError(f"sh_adam: last must be int32 of shape ({len(sh)},)")
    values = [adam.rate0, adam.rate, adam.beta1, adam.beta2, adam.eps, adam.step]
    settings = torch.tensor(values, dtype=torch.float64)
    if adam.step < 1 or not settings.isfinite().all():
        raise ValueError(f"sh_adam: step {adam.step} must be at least 1 and the rates finite")
    return adam.exp_avg, adam.exp_avg_sq, adam.last, settings


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, camera: RasterCamera, options: RasterOptions, *inputs: Any) -> Any:
        means, log_scales, quats, opacity_logits, sh = inputs
        fwd = forward(means, log_scales, quats, opacity_logits, sh, camera, options)
        ctx.fwd = fwd
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(fwd.median_depth, fwd.radii)
        # Copies: what the caller writes to, backward must not read.
        color, alpha, depth = fwd.color.clone(), fwd.alpha.clone(), fwd.depth.clone()
        return color, alpha, depth, fwd.median_depth, fwd.radii, fwd.num_visible, fwd.num_dropped

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        d_color, d_alpha, d_depth = grads[:3]
        if d_color is None:
            d_color = torch.zeros_like(ctx.fwd.color)
        g = backward(ctx.fwd, d_color, d_alpha, d_depth, means2d_abs=False)
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
    """Draw a view; color, alpha and depth carry gradients to the five tensors. See ``forward``."""
    outputs = _Render.apply(camera, options, means, log_scales, quats, opacity_logits, sh)
    return RenderOutput(*outputs)


def l1_ssim(
    rendered: torch.Tensor,
    target: torch.Tensor,
    ssim_weight: float,
    mask: torch.Tensor | None = None,
    square_weight: float = 0.0,
    threads: int = 0,
) -> LossResult:
    """The loss (1 - w) E + w (1 - SSIM), and its gradient on the render. E is the mean of
    |d| + k d^2 over the differences d: with k = 0, 3DGS's L1.

    Args:
        rendered: (H, W, 3) float32 in [0, 1] or thereabouts.
        target: (H, W, 3) float32, or uint8 of which 255 is 1.
        ssim_weight: w in [0, 1].
        mask: (H, W) bool or uint8, not zero where a pixel is left out: the render is replaced
            by the target there, and both means are over the other pixels.
        square_weight: k >= 0.
    """
    rendered = _plain("rendered", rendered, (None, None, 3))
    size = tuple(rendered.shape)
    if target.dtype == torch.uint8 and tuple(target.shape) == size:
        target = target.contiguous()
    else:
        target = _plain("target", target, size)
    if mask is not None:
        if mask.dtype not in (torch.bool, torch.uint8) or tuple(mask.shape) != size[:2]:
            raise ValueError(
                f"mask: expected bool or uint8 {size[:2]}, found {mask.dtype} {tuple(mask.shape)}"
            )
        mask = mask.contiguous().view(torch.uint8)
    return LossResult(
        *_ops().l1_ssim(rendered, target, mask, ssim_weight, square_weight, _threads(threads))
    )


def adam_step(
    param: torch.Tensor,
    grad: torch.Tensor,
    exp_avg: torch.Tensor,
    exp_avg_sq: torch.Tensor,
    lr: float | Sequence[float],
    step: int,
    beta1: float = 0.9,
    beta2: float = 0.999,
    eps: float = 1e-15,
    threads: int = 0,
) -> None:
    """One step of Adam in place, as torch.optim.Adam takes it; ``step`` counts from 1.

    All four tensors: float32, contiguous, of one shape. ``lr`` may be several rates, which repeat
    over the elements: one for each element of a row, say.

    Rows of 3 or 4 may share a second moment, that of their mean square: ``exp_avg_sq`` is (N, 1)
    then, and ``lr`` one rate. Where the rows' space is turned, the steps turn with it.
    """
    shared = tuple(exp_avg_sq.shape) == (len(param), 1) and tuple(param.shape[1:]) in ((3,), (4,))
    for tensor in (param, grad, exp_avg, exp_avg_sq):
        if tensor.dtype != torch.float32 or not tensor.is_contiguous():
            raise ValueError("adam_step: tensors must be float32 and contiguous")
        if tensor.shape != param.shape and not (shared and tensor is exp_avg_sq):
            raise ValueError(f"adam_step: shapes differ, {param.shape} and {tensor.shape}")
    if shared and not isinstance(lr, int | float):
        raise ValueError(f"adam_step: rows that share a moment have one lr, found {lr}")
    rates = torch.atleast_1d(torch.tensor(lr, dtype=torch.float64))
    if step < 1 or not len(rates) or not rates.isfinite().all():
        raise ValueError(f"adam_step: step {step} must be at least 1 and lr {lr} finite")
    _ops().adam_step(
        param.detach(), grad.detach(), exp_avg, exp_avg_sq, rates, step, beta1, beta2, eps,
        _threads(threads),
    )  # fmt: skip


def frame_adam(
    means: torch.Tensor,
    quats: torch.Tensor,
    log_scales: torch.Tensor,
    d_means: torch.Tensor,
    d_quats: torch.Tensor,
    adam: FrameAdam,
    threads: int = 0,
) -> None:
    """One step of Adam over ``means`` (N, 3) and ``quats`` (N, 4) in place, along and about each
    Gaussian's own axes (``reference.frame_adam``). float32, contiguous.

    A mean goes as many of the scales along each axis as Adam says, so a flat Gaussian slides in its
    plane, and hardly leaves it; where the world is turned or grows, the steps turn and grow with
    it. A quaternion of no direction is not turned. Axes and scales are those before the step.
    """
    moments = (adam.mean_avg, adam.mean_avg_sq, adam.turn_avg, adam.turn_avg_sq)
    fours = (quats, d_quats)
    for tensor in (means, log_scales, d_means, *moments, *fours):
        if tensor.dtype != torch.float32 or not tensor.is_contiguous():
            raise ValueError("frame_adam: tensors must be float32 and contiguous")
        width = 4 if any(tensor is four for four in fours) else 3
        if tensor.shape != (len(means), width):
            raise ValueError(
                f"frame_adam: expected ({len(means)}, {width}), found {tuple(tensor.shape)}"
            )
    rates = torch.tensor([adam.mean_rate, adam.turn_rate], dtype=torch.float64)
    if adam.step < 1 or not rates.isfinite().all():
        raise ValueError(f"frame_adam: step {adam.step} must be at least 1 and rates finite")
    _ops().frame_adam(
        means.detach(), quats.detach(), log_scales.detach(), d_means.detach(), d_quats.detach(),
        *moments, rates, adam.step, adam.beta1, adam.beta2, adam.eps, _threads(threads),
    )  # fmt: skip
