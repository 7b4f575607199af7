"""The backend of C++ kernels. float32, contiguous tensors on the CPU."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pipeline.render import checks
from pipeline.render.backend import Backend
from pipeline.render.checks import Parameters
from pipeline.render.cpu import build
from pipeline.render.types import (
    AdamRates,
    AlphaChangeLoss,
    CameraGradients,
    Forward,
    FrameMoments,
    GaussianAdam,
    Gradients,
    ImageGradients,
    LossResult,
    Moments,
    RasterCamera,
    RasterOptions,
    ShAdam,
    Subset,
    Surroundings,
    ViewGradients,
)
from pipeline.runtime.errors import UserError


@dataclass(frozen=True)
class Projected:
    """The result of ``project``; csrc/types.h defines the layouts."""

    inputs: Parameters
    camera: RasterCamera
    options: RasterOptions
    view: Tensor  # see _pack_view
    records: Tensor  # (N, 16)
    radii: Tensor  # (N,)
    num_visible: int
    num_dropped: int

    @property
    def size(self) -> tuple[int, int]:
        """The width and the height of the image."""
        return self.camera.width, self.camera.height

    @property
    def threads(self) -> int:
        return _threads(self.options.threads)


@dataclass(frozen=True)
class Binned:
    """The result of ``bin``."""

    projected: Projected
    entries: Tensor  # (M, 3) int32
    tile_begin: Tensor  # (tiles + 1,) int64
    slots: Tensor  # (N, 2) int32


@dataclass(frozen=True)
class State(Binned):
    """The state of a rendered view for ``backward``."""

    block_end: Tensor  # (tiles, blocks of a tile) int32


def _ops() -> Any:
    build.load()
    return torch.ops.splatmake


def _threads(threads: int) -> int:
    return threads if threads > 0 else torch.get_num_threads()


def _pack_view(camera: RasterCamera, options: RasterOptions) -> Tensor:
    """(29,) float64: fx fy cx cy, the rotation by rows, the translation, the near plane, the bounds
    of u and v in the Jacobian, width, height, the SH degree, two flags and the background."""
    rows = camera.world_to_camera.tolist()[:3]
    rotation = (value for row in rows for value in row[:3])
    flags = options.antialias, options.clamp_color_gradient
    size = camera.width, camera.height
    background = options.background or (0.0, 0.0, 0.0)
    return _doubles(
        *(camera.fx, camera.fy, camera.cx, camera.cy, *rotation, *(row[3] for row in rows)),
        *(options.near, *camera.slopes, *size, options.sh_degree, *flags, *background),
    )


def _pack_adam(rates: AdamRates) -> Tensor:
    """Float64: the step, beta1, beta2, epsilon and the learning rates."""
    return _doubles(rates.step, rates.beta1, rates.beta2, rates.eps, *rates.rates)


def _doubles(*values: float) -> Tensor:
    """A float64 tensor. ``torch.tensor`` takes three times as long, in each of a step's calls."""
    return torch.frombuffer(array("d", values), dtype=torch.float64)


def _slot_gradients(
    fwd: Forward, d_color: Tensor, d_alpha: Tensor | None, d_depth: Tensor | None
) -> Tensor:
    """(M, 16) gradients of each pair, see csrc/types.h."""
    s: State = fwd.state
    p = s.projected
    d_color, d_alpha, d_depth = checks.image_gradients(d_color, d_alpha, d_depth, p.size)
    return _ops().blend_backward(
        p.records, s.entries, s.tile_begin, s.block_end, p.view, fwd.color, fwd.alpha,
        None if d_depth is None else fwd.depth, d_color, d_alpha, d_depth, p.threads,
    )  # fmt: skip


class CpuBackend(Backend[Projected, Binned]):
    """Multithreaded kernels for the vector instructions of the processor."""

    def facts(self) -> Mapping[str, str]:
        built = build.load()
        return {"instruction_set": built.target, "compiler": built.compiler}

    def release_memory(self) -> None:
        _ops().release_memory()

    def save_memory(self, little: bool) -> None:
        _ops().save_memory(little)

    def project(
        self, parameters: Parameters, camera: RasterCamera, options: RasterOptions
    ) -> Projected:
        view = _pack_view(camera, options)
        projected = _ops().project(*parameters, view, _threads(options.threads))
        return Projected(parameters, camera, options, view, *projected)

    def subset_of(self, projected: Projected, subset: Subset) -> Projected:
        radii = torch.where(subset.which, projected.radii, 0.0)
        options = replace(projected.options, background=subset.background)
        return replace(
            projected,
            options=options,
            view=_pack_view(projected.camera, options),
            radii=radii,
            num_visible=int((radii > 0).sum()),
        )

    def bin(self, projected: Projected) -> Binned:
        p = projected
        *lists, fits = _ops().bin(p.records, p.radii, p.view, p.threads)
        if not fits:
            raise UserError(
                f"{p.num_visible} Gaussians overlap more than 2^27 tiles of 16 x 16 pixels in one "
                "view",
                fix="render smaller images, or remove Gaussians that are far too large",
            )
        return Binned(projected, *lists)

    def blend(self, binned: Binned) -> Forward:
        p, ops = binned.projected, _ops()
        pairs = p.records, binned.entries, binned.tile_begin
        color, alpha, block_end = ops.blend(*pairs, p.view, p.threads)

        def render_depths() -> tuple[Tensor, Tensor]:
            depth, median = ops.blend_depth(*pairs, p.view, p.threads)
            return depth, median

        return Forward(
            color, alpha, p.radii, p.num_visible, p.num_dropped, len(binned.entries),
            render_depths, State(**vars(binned), block_end=block_end),
        )  # fmt: skip

    def backward(
        self,
        fwd: Forward,
        d_color: Tensor,
        d_alpha: Tensor | None = None,
        d_depth: Tensor | None = None,
        *,
        colors: bool = False,
        camera: bool = False,
        sh_adam: ShAdam | None = None,
    ) -> Gradients:
        s: State = fwd.state
        p, slot_gradients = s.projected, _slot_gradients(fwd, d_color, d_alpha, d_depth)
        adam: tuple[Tensor | None, ...] = None, None, None, None
        if sh_adam is not None:
            checks.check_sh_adam(sh_adam, p.inputs[4])
            moments = sh_adam.moments
            adam = moments.exp_avg, moments.exp_avg_sq, sh_adam.last, _pack_adam(sh_adam.rates)
        found = _ops().project_backward(
            *p.inputs, p.view, p.records, fwd.radii, s.slots, slot_gradients, colors, camera, *adam,
            p.threads,
        )  # fmt: skip
        d_means, d_scales, d_quats, d_opacity, d_sh, d_means2d, d_colors, d_camera = found
        return Gradients(
            d_means, d_scales, d_quats, d_opacity, d_sh, d_means2d, d_colors if colors else None,
            CameraGradients(*d_camera.split([3, 3, 2, 2])) if camera else None,
        )  # fmt: skip

    def update(
        self,
        fwd: Forward,
        parameters: Parameters,
        gradients: ImageGradients,
        *,
        adam: GaussianAdam,
        statistics: tuple[Tensor, Tensor] | None = None,
        colors: bool = False,
        camera: bool = False,
    ) -> ViewGradients:
        s: State = fwd.state
        p, slot_gradients = s.projected, _slot_gradients(fwd, *gradients)
        checks.check_update(parameters, adam, statistics, len(fwd.radii))
        moments = (
            *(adam.frames.means, adam.frames.rotations),
            *(adam.log_scales, adam.opacity_logits, adam.sh.moments),
        )
        rates = adam.frame_rates, adam.log_scale_rates, adam.opacity_rates, adam.sh.rates
        gradient_sum, seen = statistics or (None, None)
        d_colors, d_camera = _ops().project_backward_update(
            *parameters, p.view, p.records, fwd.radii, s.slots, slot_gradients,
            [tensor for each in moments for tensor in (each.exp_avg, each.exp_avg_sq)],
            adam.sh.last, [_pack_adam(each) for each in rates], gradient_sum, seen, colors, camera,
            p.threads,
        )  # fmt: skip
        return ViewGradients(
            d_colors if colors else None,
            CameraGradients(*d_camera.split([3, 3, 2, 2])) if camera else None,
        )

    def l1_ssim(
        self,
        rendered: Tensor,
        target: Tensor,
        ssim_weight: float,
        mask: Tensor | None = None,
        l2_weight: float = 0.0,
        threads: int = 0,
        *,
        factor: Tensor | None = None,
    ) -> LossResult:
        rendered, target, mask, factor = checks.images(rendered, target, mask, factor)
        weights = ssim_weight, l2_weight
        found = _ops().l1_ssim(rendered, factor, target, mask, *weights, _threads(threads))
        return LossResult(*found)

    def compose(
        self, around: Surroundings, color: Tensor, alpha: Tensor, threads: int = 0
    ) -> Tensor:
        color, alpha = checks.layers(around, color, alpha)
        return _ops().compose(
            around.behind, around.alpha, around.front, around.transmittance, around.correction,
            color, alpha, _threads(threads),
        )  # fmt: skip

    def compose_backward(
        self,
        around: Surroundings,
        alpha: Tensor,
        d_image: Tensor,
        loss: AlphaChangeLoss,
        threads: int = 0,
    ) -> tuple[Tensor, Tensor]:
        d_image, alpha = checks.layers(around, d_image, alpha)
        return _ops().compose_backward(
            around.behind, around.alpha, around.front, around.transmittance, alpha, d_image,
            loss.weight, loss.fade, loss.growth, _threads(threads),
        )  # fmt: skip

    def observe_gradients(
        self,
        rendered: Forward,
        gradients: Gradients,
        gradient_sum: Tensor,
        seen: Tensor,
        threads: int = 0,
    ) -> None:
        rows = len(rendered.radii)
        means2d = checks.checked("means2d", gradients.means2d, (rows, 2))
        for name, tensor in (("gradient_sum", gradient_sum), ("seen", seen)):
            checks.checked(name, tensor, (rows,))
        height, width = rendered.alpha.shape
        tensors = means2d, rendered.radii, gradient_sum, seen
        _ops().observe_gradients(*tensors, 0.5 * width, 0.5 * height, _threads(threads))

    def adam_step(
        self, param: Tensor, grad: Tensor, moments: Moments, rates: AdamRates, threads: int = 0
    ) -> None:
        checks.check_adam(param, grad, moments, rates)
        tensors = param.detach(), grad.detach(), moments.exp_avg, moments.exp_avg_sq
        _ops().adam_step(*tensors, _pack_adam(rates), _threads(threads))

    def frame_adam(
        self,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        d_means: Tensor,
        d_quats: Tensor,
        moments: FrameMoments,
        rates: AdamRates,
        threads: int = 0,
    ) -> None:
        tensors = means, quats, log_scales, d_means, d_quats
        checks.check_frame_adam(tensors[:3], tensors[3:], moments, rates)
        of_means, of_rotations = moments.means, moments.rotations
        _ops().frame_adam(
            *(tensor.detach() for tensor in tensors), of_means.exp_avg, of_means.exp_avg_sq,
            of_rotations.exp_avg, of_rotations.exp_avg_sq, _pack_adam(rates), _threads(threads),
        )  # fmt: skip
