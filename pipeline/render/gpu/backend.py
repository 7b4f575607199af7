"""The backend of WebGPU kernels: tensors on the CPU are copied to the device and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from pipeline.render import checks
from pipeline.render.backend import Backend
from pipeline.render.checks import Parameters
from pipeline.render.gpu import adam, layout, rasterise
from pipeline.render.gpu.device import Buffer, Gpu
from pipeline.render.gpu.loss import LossImage, compose, l1_ssim, upload_layers
from pipeline.render.gpu.primitives import sum_rows
from pipeline.render.gpu.resident import GpuTraining
from pipeline.render.gpu.scene_cache import SceneCache
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.types import (
    AdamRates,
    AlphaChangeLoss,
    CameraGradients,
    Forward,
    FrameMoments,
    Gradients,
    LossResult,
    Moments,
    RasterCamera,
    RasterOptions,
    ShAdam,
    Subset,
    Surroundings,
)

NAMES = ("means", "log_scales", "quats", "opacity_logits")


@dataclass(frozen=True)
class Projected:
    """The result of ``project``. ``sh`` is the tensor that ``ShAdam`` updates."""

    sh: Tensor
    camera: RasterCamera
    options: RasterOptions
    projection: rasterise.Projection
    radii: Tensor


@dataclass(frozen=True)
class Binned:
    """The result of ``bin``."""

    projected: Projected
    lists: rasterise.Lists
    totals: rasterise.Totals


@dataclass(frozen=True)
class State:
    """The state of a rendered view for ``backward``."""

    sh: Tensor
    image: rasterise.Image


class GpuBackend(Backend[Projected, Binned]):
    """WGSL kernels on one device, opened at first use. Results have the same bits at every run on
    the same device and driver.

    Args:
        number: The number of the device, in the order of ``device.adapters``.
    """

    def __init__(self, number: int = 0):
        self.number = number
        self.scenes = SceneCache()

    @cached_property
    def gpu(self) -> Gpu:
        return Gpu(self.number)

    def facts(self) -> Mapping[str, str]:
        adapter = self.gpu.adapter
        return {"instruction_set": str(adapter), "compiler": adapter.driver}

    def resident(self) -> GpuTraining:
        return GpuTraining(self.gpu, self.scenes)

    def project(
        self, parameters: Parameters, camera: RasterCamera, options: RasterOptions
    ) -> Projected:
        gpu, scene = self.gpu, self.scenes.get(self.gpu, parameters)
        view = gpu.upload(layout.pack_view(camera, options, scene.count, scene.coefficients))
        size = camera.width, camera.height
        projection = rasterise.project(Workspace(gpu), scene, view, size)
        radii = torch.from_numpy(gpu.read(projection.radii, np.float32, scene.count))
        return Projected(parameters[4], camera, options, projection, radii)

    def subset_of(self, projected: Projected, subset: Subset) -> Projected:
        gpu, whole = self.gpu, projected.projection
        count = whole.scene.count
        options = replace(projected.options, background=subset.background)
        view = layout.pack_view(projected.camera, options, count, whole.scene.coefficients)
        radii = torch.where(subset.which, projected.radii, 0.0)
        tiles = gpu.read(whole.tile_counts, np.uint32, count) * subset.which.numpy()
        depths = gpu.read(whole.depths, np.uint32, count) * subset.which.numpy()
        projection = replace(
            whole,
            view=gpu.upload(view),
            radii=gpu.upload(radii.numpy()),
            tile_counts=gpu.upload(tiles.astype(np.uint32)),
            depths=gpu.upload(depths.astype(np.uint32)),
        )
        return replace(projected, options=options, projection=projection, radii=radii)

    def bin(self, projected: Projected) -> Binned:
        gpu, projection = self.gpu, projected.projection
        size = 4 * projection.scene.count
        depths = gpu.empty(size)  # ``list_pairs`` overwrites it.
        gpu.copy(projection.depths, 0, depths, 0, size)
        lists, totals = rasterise.list_pairs(Workspace(gpu), replace(projection, depths=depths))
        return Binned(projected, lists, totals)

    def blend(self, binned: Binned) -> Forward:
        gpu, totals, projected = self.gpu, binned.totals, binned.projected
        image = rasterise.blend(Workspace(gpu), binned.lists, planes=True)
        alpha = image.plane(gpu, 0)
        color = torch.from_numpy(gpu.read(image.color, np.float32, 3 * alpha.numel()))
        return Forward(
            color.view(*alpha.shape, 3), alpha, projected.radii, totals.visible,
            totals.dropped, totals.pairs, lambda: (image.plane(gpu, 1), image.plane(gpu, 2)),
            State(projected.sh, image),
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
        state: State = fwd.state
        gpu, image, sh = self.gpu, state.image, state.sh
        projection = image.lists.projection
        size, scene = projection.size, projection.scene
        count = scene.count
        d_color, d_alpha, d_depth = checks.image_gradients(d_color, d_alpha, d_depth, size)
        d_planes = np.zeros((2, size[1], size[0]), np.float32)
        for plane, gradient in zip(d_planes, (d_alpha, d_depth), strict=True):
            if gradient is not None:
                plane[:] = gradient.numpy()
        d_sh = sh.new_empty(len(sh) if sh_adam is None else 0, *sh.shape[1:])
        if sh_adam is None:
            tensors = {"d_sh": d_sh}
            more = {"d_sh": gpu.empty(4 * sh.numel(), what="the gradients of SH")}
        else:
            checks.check_sh_adam(sh_adam, sh)
            tensors = {**vars(sh_adam.moments), "last_step": sh_adam.last}
            more = {name: gpu.upload(layout.join([each])) for name, each in tensors.items()}
        if camera:
            more["d_camera"] = gpu.empty(4 * layout.CAMERA_PARAMETERS * count)
        # A copy of the SH coefficients: further views may be rendered from the same projection.
        updated = gpu.empty(4 * sh.numel())
        gpu.copy(scene.sh, 0, updated, 0, 4 * sh.numel())
        space = Workspace(gpu)
        projection = replace(projection, scene=replace(scene, sh=updated))
        slots = rasterise.blend_backward(
            space, image, gpu.upload(d_color.numpy()), gpu.upload(d_planes)
        )
        rates = None if sh_adam is None else sh_adam.rates
        lists = replace(image.lists, projection=projection)
        gradients = rasterise.project_backward(space, lists, slots, rates, **more)
        if sh_adam is not None:
            layout.fetch(gpu, updated, sh)
        for name, tensor in tensors.items():
            layout.fetch(gpu, more[name], tensor)
        found = layout.split(layout.GRADIENTS, gradients, gpu, count)
        return Gradients(
            found["means"], found["log_scales"], found["quats"], found["opacity_logits"][:, 0],
            d_sh, found["means2d"], found["colors"] if colors else None,
            _camera_gradients(space, more["d_camera"], count) if camera else None,
        )  # fmt: skip

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
        if factor is not None:
            rendered = rendered * factor
        gpu, (height, width, _) = self.gpu, rendered.shape
        space, image = Workspace(gpu), LossImage.upload(gpu, target, mask)
        found = l1_ssim(
            space, gpu.upload(rendered.numpy()), image, (width, height), ssim_weight, l2_weight
        )
        error, ssim, squared = found.means(sum_rows(space, found.sums, found.rows, 4))
        loss = (1 - ssim_weight) * error + ssim_weight * (1 - ssim)
        grad = torch.from_numpy(gpu.read(found.gradient, np.float32, rendered.numel()))
        grad = grad.view(rendered.shape)
        return LossResult(loss, error, ssim, squared, grad if factor is None else grad * factor)

    def compose(
        self, around: Surroundings, color: Tensor, alpha: Tensor, threads: int = 0
    ) -> Tensor:
        color, alpha = checks.layers(around, color, alpha)
        nothing = AlphaChangeLoss(0.0, 0.0, 0.0)
        result, _ = self._composition("compose.compose", around, alpha, color, nothing)
        return result

    def compose_backward(
        self,
        around: Surroundings,
        alpha: Tensor,
        d_image: Tensor,
        loss: AlphaChangeLoss,
        threads: int = 0,
    ) -> tuple[Tensor, Tensor]:
        d_image, alpha = checks.layers(around, d_image, alpha)
        return self._composition("compose.backward", around, alpha, d_image, loss)

    def adam_step(
        self, param: Tensor, grad: Tensor, moments: Moments, rates: AdamRates, threads: int = 0
    ) -> None:
        checks.check_adam(param, grad, moments, rates)
        gpu, parameter, both = self.gpu, param.detach(), vars(moments)
        buffers = {
            "parameter": gpu.upload(parameter.numpy()),
            "moments": gpu.upload(layout.join(both.values())),
        }
        adam.adam_step(
            Workspace(gpu), "a tensor", rates, (len(param), param[:1].numel()),
            shared=moments.exp_avg_sq.shape != param.shape,
            gradient=gpu.upload(grad.detach().numpy()), **buffers,
        )  # fmt: skip
        layout.fetch(gpu, buffers["parameter"], parameter)
        layout.fetch(gpu, buffers["moments"], *both.values())

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
        parameters = means, quats, log_scales
        checks.check_frame_adam(parameters, (d_means, d_quats), moments, rates)
        gpu, count = self.gpu, len(means)
        tensors = {
            "geometry": (means, log_scales, quats),
            "gradients": (d_means, d_quats),
            "moments": (*vars(moments.means).values(), *vars(moments.rotations).values()),
        }
        buffers = {name: gpu.upload(layout.join(each)) for name, each in tensors.items()}
        adam.frame_adam(Workspace(gpu), rates, count, **buffers)
        for name in ("geometry", "moments"):
            layout.fetch(gpu, buffers[name], *tensors[name])

    def _composition(
        self,
        kernel: str,
        around: Surroundings,
        alpha: Tensor,
        values: Tensor,
        loss: AlphaChangeLoss,
    ) -> tuple[Tensor, Tensor]:
        gpu, pixels = self.gpu, alpha.numel()
        result, d_alpha = gpu.empty(12 * pixels), gpu.empty(4 * pixels)
        compose(
            Workspace(gpu), kernel, upload_layers(gpu, around), pixels, loss, result=result,
            alpha=gpu.upload(alpha.numpy()), values=gpu.upload(values.numpy()), d_alpha=d_alpha,
        )  # fmt: skip
        images = torch.empty_like(values), torch.empty_like(alpha)
        layout.fetch(gpu, result, images[0])
        layout.fetch(gpu, d_alpha, images[1])
        return images


def _camera_gradients(space: Workspace, rows: Buffer, count: int) -> CameraGradients:
    return rasterise.camera_gradients(sum_rows(space, rows, count, layout.CAMERA_PARAMETERS))
