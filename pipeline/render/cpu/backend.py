"""The backend of C++ kernels. float32, contiguous tensors on the CPU."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch

from pipeline.render import checks
from pipeline.render.backend import Backend
from pipeline.render.checks import Parameters
from pipeline.render.cpu import build
from pipeline.render.types import (
    AlphaChangeLoss,
    CameraGradients,
    DenseAdam,
    Forward,
    FrameAdam,
    Gradients,
    LossResult,
    RasterCamera,
    RasterOptions,
    ShAdam,
    Subset,
    Surroundings,
)
from pipeline.runtime.errors import UserError


@dataclass(frozen=True)
class Projected:
    """Result of ``project``; layouts are in csrc/types.h."""

    inputs: Parameters
    view: torch.Tensor  # (21,) float64
    size: tuple[int, int]  # width, height
    options: RasterOptions
    records: torch.Tensor  # (N, 16)
    radii: torch.Tensor  # (N,)
    num_visible: int
    num_dropped: int

    @property
    def threads(self) -> int:
        return _threads(self.options.threads)


@dataclass(frozen=True)
class Binned:
    """Result of ``bin``."""

    projected: Projected
    entries: torch.Tensor  # (M, 3) int32
    tile_begin: torch.Tensor  # (tiles + 1,) int64
    slots: torch.Tensor  # (N, 2) int32


@dataclass(frozen=True)
class State:
    """State of a rendered view for ``backward``."""

    inputs: Parameters
    view: torch.Tensor
    size: tuple[int, int]
    background: torch.Tensor  # (3,)
    options: RasterOptions
    records: torch.Tensor
    entries: torch.Tensor
    tile_begin: torch.Tensor
    block_end: torch.Tensor  # (tiles, blocks of a tile) int32
    slots: torch.Tensor


def _ops() -> Any:
    build.load()
    return torch.ops.splatmake


def _threads(threads: int) -> int:
    return threads if threads > 0 else torch.get_num_threads()


def _pack_view(camera: RasterCamera, near: float) -> torch.Tensor:
    """(21,) float64: fx fy cx cy, rotation by rows, translation, near, bounds of u and v in the
    Jacobian."""
    pose = camera.world_to_camera.detach().double()
    head = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
    tail = torch.tensor([near, *camera.slopes], dtype=torch.float64)
    return torch.cat([head, pose[:3, :3].reshape(-1), pose[:3, 3], tail])


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
        view, size = _pack_view(camera, options.near), (camera.width, camera.height)
        found = _ops().project(
            *parameters, view, *size, options.sh_degree, options.antialias,
            _threads(options.threads),
        )  # fmt: skip
        return Projected(parameters, view, size, options, *found)

    def subset_of(self, projected: Projected, subset: Subset) -> Projected:
        radii = torch.where(subset.which, projected.radii, 0.0)
        options = replace(projected.options, background=subset.background)
        return replace(projected, radii=radii, options=options, num_visible=int((radii > 0).sum()))

    def bin(self, projected: Projected) -> Binned:
        p = projected
        entries, tile_begin, slots, fits = _ops().bin(
            p.records, p.radii, p.view, *p.size, p.threads
        )
        if not fits:
            raise UserError(
                f"{p.num_visible} Gaussians overlap more than 2^27 tiles of 16 x 16 pixels in one "
                "view",
                fix="render smaller images, or remove Gaussians that are far too large",
            )
        return Binned(projected, entries, tile_begin, slots)

    def blend(self, binned: Binned) -> Forward:
        p, ops, entries, tile_begin = binned.projected, _ops(), binned.entries, binned.tile_begin
        background = torch.tensor(p.options.background or (0.0, 0.0, 0.0), dtype=torch.float32)
        color, alpha, block_end = ops.blend(
            p.records, entries, tile_begin, p.view, *p.size, background, p.threads
        )
        state = State(
            p.inputs, p.view, p.size, background, p.options, p.records, entries, tile_begin,
            block_end, binned.slots,
        )  # fmt: skip

        def render_depths() -> tuple[torch.Tensor, torch.Tensor]:
            depth, median = ops.blend_depth(
                p.records, entries, tile_begin, p.view, *p.size, p.threads
            )
            return depth, median

        return Forward(
            color, alpha, p.radii, p.num_visible, p.num_dropped, entries.shape[0], render_depths,
            state,
        )  # fmt: skip

    def backward(
        self,
        fwd: Forward,
        d_color: torch.Tensor,
        d_alpha: torch.Tensor | None = None,
        d_depth: torch.Tensor | None = None,
        *,
        colors: bool = False,
        camera: bool = False,
        sh_adam: ShAdam | None = None,
    ) -> Gradients:
        s: State = fwd.state
        width, height = s.size
        d_color, d_alpha, d_depth = checks.image_gradients(d_color, d_alpha, d_depth, s.size)
        ops, threads = _ops(), _threads(s.options.threads)
        slot_gradients = ops.blend_backward(
            s.records, s.entries, s.tile_begin, s.block_end, s.view, width, height, s.background,
            fwd.color, fwd.alpha, None if d_depth is None else fwd.depth, d_color, d_alpha, d_depth,
            threads,
        )  # fmt: skip
        d_means, d_scales, d_quats, d_opacity, d_sh, d_means2d, d_colors, d_camera = (
            ops.project_backward(
                *s.inputs, s.view, width, height, s.options.sh_degree, s.options.antialias,
                s.records, fwd.radii, s.slots, slot_gradients, s.options.clamp_color_gradient,
                colors, camera, *_moments(sh_adam, s.inputs[4]), threads,
            )
        )  # fmt: skip
        parts = d_camera.split([3, 3, 2, 2]) if camera else None
        return Gradients(
            d_means, d_scales, d_quats, d_opacity, d_sh, d_means2d,
            d_colors if colors else None,
            None if parts is None else CameraGradients(*parts),
        )  # fmt: skip

    def l1_ssim(
        self,
        rendered: torch.Tensor,
        target: torch.Tensor,
        ssim_weight: float,
        mask: torch.Tensor | None = None,
        l2_weight: float = 0.0,
        threads: int = 0,
    ) -> LossResult:
        images = checks.images(rendered, target, mask)
        return LossResult(*_ops().l1_ssim(*images, ssim_weight, l2_weight, _threads(threads)))

    def compose(
        self, around: Surroundings, color: torch.Tensor, alpha: torch.Tensor, threads: int = 0
    ) -> torch.Tensor:
        color, alpha = checks.layers(around, color, alpha)
        return _ops().compose(
            around.behind, around.alpha, around.front, around.transmittance, around.correction,
            color, alpha, _threads(threads),
        )  # fmt: skip

    def compose_backward(
        self,
        around: Surroundings,
        alpha: torch.Tensor,
        d_image: torch.Tensor,
        loss: AlphaChangeLoss,
        threads: int = 0,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        d_image, alpha = checks.layers(around, d_image, alpha)
        return _ops().compose_backward(
            around.behind, around.alpha, around.front, around.transmittance, alpha, d_image,
            loss.weight, loss.fade, loss.growth, _threads(threads),
        )  # fmt: skip

    def adam_step(
        self, param: torch.Tensor, grad: torch.Tensor, adam: DenseAdam, threads: int = 0
    ) -> None:
        checks.check_adam(param, grad, adam)
        rates = torch.atleast_1d(torch.tensor(adam.lr, dtype=torch.float64))
        _ops().adam_step(
            param.detach(), grad.detach(), adam.exp_avg, adam.exp_avg_sq, rates, adam.step,
            adam.beta1, adam.beta2, adam.eps, _threads(threads),
        )  # fmt: skip

    def frame_adam(
        self,
        means: torch.Tensor,
        quats: torch.Tensor,
        log_scales: torch.Tensor,
        d_means: torch.Tensor,
        d_quats: torch.Tensor,
        adam: FrameAdam,
        threads: int = 0,
    ) -> None:
        checks.check_frame_adam(means, quats, log_scales, d_means, d_quats, adam)
        rates = torch.tensor([adam.mean_rate, adam.rotation_rate], dtype=torch.float64)
        _ops().frame_adam(
            means.detach(), quats.detach(), log_scales.detach(), d_means.detach(),
            d_quats.detach(), adam.mean_avg, adam.mean_avg_sq, adam.rotation_avg,
            adam.rotation_avg_sq, rates, adam.step, adam.beta1, adam.beta2, adam.eps,
            _threads(threads),
        )  # fmt: skip


def _moments(adam: ShAdam | None, sh: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    if adam is None:
        return None, None, None, None
    checks.check_sh_adam(adam, sh)
    values = [adam.dc_rate, adam.rate, adam.beta1, adam.beta2, adam.eps, adam.step]
    return adam.exp_avg, adam.exp_avg_sq, adam.last, torch.tensor(values, dtype=torch.float64)
