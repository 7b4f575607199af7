"""The backend of WebGPU kernels: tensors on the CPU are copied to the device and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.render import checks
from pipeline.render.backend import Backend
from pipeline.render.checks import Parameters
from pipeline.render.gpu import layout, rasterise
from pipeline.render.gpu.adam import adam_uniform, frame_uniform, sh_options
from pipeline.render.gpu.device import Buffer, Gpu, blocks
from pipeline.render.gpu.loss import LossImage, l1_ssim, layers_uniform, upload_layers
from pipeline.render.gpu.reduce import camera_gradients
from pipeline.render.gpu.resident import GpuTraining
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.types import (
    AlphaChangeLoss,
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


@dataclass(frozen=True)
class Projected:
    """Result of ``project``. ``sh``: the tensor of ``scene.sh``, which ``ShAdam`` updates."""

    scene: rasterise.Scene
    sh: torch.Tensor
    camera: RasterCamera
    options: RasterOptions
    projection: rasterise.Projection
    radii: torch.Tensor


@dataclass(frozen=True)
class Binned:
    """Result of ``bin``."""

    projected: Projected
    lists: rasterise.Lists


@dataclass(frozen=True)
class State:
    """State of a rendered view for ``backward``."""

    projected: Projected
    lists: rasterise.Lists
    image: rasterise.Image


class GpuBackend(Backend[Projected, Binned]):
    """WGSL kernels on one device, opened at first use. Results have the same bits at every run on
    the same device and driver.

    Args:
        number: of the device, in the order of ``device.adapters``.
    """

    def __init__(self, number: int = 0):
        self.number = number
        self._last: tuple[object, rasterise.Scene, Parameters] | None = None

    @cached_property
    def gpu(self) -> Gpu:
        return Gpu(self.number)

    def facts(self) -> Mapping[str, str]:
        adapter = self.gpu.adapter
        return {"instruction_set": str(adapter), "compiler": adapter.driver}

    def resident(self) -> GpuTraining:
        return GpuTraining(self.gpu)

    def project(
        self, parameters: Parameters, camera: RasterCamera, options: RasterOptions
    ) -> Projected:
        gpu, count, sh = self.gpu, len(parameters[0]), parameters[4]
        scene = self._scene(parameters)
        view = gpu.upload(layout.pack_view(camera, options, count, sh.shape[1]))
        size = camera.width, camera.height
        projection = rasterise.project(gpu, Workspace(gpu), scene, view, size)
        radii = torch.from_numpy(gpu.read(projection.radii, np.float32, count))
        return Projected(scene, sh, camera, options, projection, radii)

    def subset_of(self, projected: Projected, subset: Subset) -> Projected:
        gpu, count, whole = self.gpu, projected.scene.count, projected.projection
        options = replace(projected.options, background=subset.background)
        view = layout.pack_view(projected.camera, options, count, projected.scene.coefficients)
        radii = torch.where(subset.which, projected.radii, 0.0)
        tiles = gpu.read(whole.tile_counts, np.uint32, count) * subset.which.numpy()
        projection = replace(
            whole,
            view=gpu.upload(view),
            radii=gpu.upload(radii.numpy()),
            tile_counts=gpu.upload(tiles.astype(np.uint32)),
            visible=gpu.upload((radii > 0).numpy().astype(np.uint32)),
        )
        return replace(projected, options=options, projection=projection, radii=radii)

    def bin(self, projected: Projected) -> Binned:
        space, count = Workspace(self.gpu), projected.scene.count
        return Binned(projected, rasterise.list_pairs(self.gpu, space, projected.projection, count))

    def blend(self, binned: Binned) -> Forward:
        gpu, lists, projected = self.gpu, binned.lists, binned.projected
        image = rasterise.blend(gpu, Workspace(gpu), projected.projection, lists)
        width, height = projected.projection.size
        pixels = width * height

        def plane(number: int) -> torch.Tensor:
            found = gpu.read(image.planes, np.float32, pixels, 4 * pixels * number)
            return torch.from_numpy(found).view(height, width)

        color = torch.from_numpy(gpu.read(image.color, np.float32, 3 * pixels))
        return Forward(
            color.view(height, width, 3), plane(0), projected.radii, lists.num_visible,
            lists.num_dropped, lists.length, lambda: (plane(1), plane(2)),
            State(projected, lists, image),
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
        state: State = fwd.state
        gpu, projected = self.gpu, state.projected
        scene, projection, sh = projected.scene, projected.projection, projected.sh
        size, count = projection.size, scene.count
        d_color, d_alpha, d_depth = checks.image_gradients(d_color, d_alpha, d_depth, size)
        d_planes = np.zeros((2, size[1], size[0]), np.float32)
        for plane, gradient in zip(d_planes, (d_alpha, d_depth), strict=True):
            if gradient is not None:
                plane[:] = gradient.numpy()
        space = Workspace(gpu)
        slots = rasterise.blend_backward(
            gpu, space, projection, state.lists, state.image, gpu.upload(d_color.numpy()),
            gpu.upload(d_planes),
        )  # fmt: skip
        if sh_adam is not None:
            checks.check_sh_adam(sh_adam, sh)
            moments = {
                "exp_avg": gpu.upload(sh_adam.exp_avg.numpy()),
                "exp_avg_sq": gpu.upload(sh_adam.exp_avg_sq.numpy()),
                "last_step": gpu.upload(sh_adam.last.numpy()),
            }
        else:
            moments = {"d_sh": gpu.empty(4 * sh.numel(), what="the gradients of SH")}
        if camera:
            moments["d_camera"] = gpu.empty(4 * layout.CAMERA_PARAMETERS * count)
        # A copy of the SH coefficients: further views may be rendered from the same projection.
        updated = gpu.empty(4 * sh.numel())
        gpu.copy(scene.sh, 0, updated, 0, 4 * sh.numel())
        gradients = rasterise.project_backward(
            space, replace(scene, sh=updated), projection, state.lists, slots,
            sh_options(space, sh_adam, camera), **moments,
        )  # fmt: skip
        if sh_adam is not None:
            self._fetch(updated, sh)
            self._fetch(moments["exp_avg"], sh_adam.exp_avg)
            self._fetch(moments["exp_avg_sq"], sh_adam.exp_avg_sq)
            self._fetch(moments["last_step"], sh_adam.last)
        found = self._read_sections(layout.GRADIENTS, gradients, count)
        d_sh = sh.new_zeros(0, *sh.shape[1:])
        if sh_adam is None:
            d_sh = torch.from_numpy(gpu.read(moments["d_sh"], np.float32, sh.numel()))
            d_sh = d_sh.view(sh.shape)
        return Gradients(
            found["means"], found["log_scales"], found["quats"], found["opacity_logits"][:, 0],
            d_sh, found["means2d"], found["colors"] if colors else None,
            camera_gradients(gpu, space, moments["d_camera"], count) if camera else None,
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
        rendered, target, mask = checks.images(rendered, target, mask)
        gpu, (height, width, _) = self.gpu, rendered.shape
        space, image = Workspace(gpu), LossImage.upload(gpu, target, mask)
        found = l1_ssim(
            gpu, space, gpu.upload(rendered.numpy()), image, (width, height), ssim_weight, l2_weight
        )
        error, ssim, _ = found.values(gpu, space)
        loss = (1 - ssim_weight) * error + ssim_weight * (1 - ssim)
        grad = torch.from_numpy(gpu.read(found.gradient, np.float32, rendered.numel()))
        return LossResult(loss, error, ssim, grad.view(rendered.shape))

    def compose(
        self, around: Surroundings, color: torch.Tensor, alpha: torch.Tensor, threads: int = 0
    ) -> torch.Tensor:
        color, alpha = checks.layers(around, color, alpha)
        nothing = AlphaChangeLoss(0.0, 0.0, 0.0)
        result, _ = self._composition("compose.compose", around, alpha, color, nothing)
        return result

    def compose_backward(
        self,
        around: Surroundings,
        alpha: torch.Tensor,
        d_image: torch.Tensor,
        loss: AlphaChangeLoss,
        threads: int = 0,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        d_image, alpha = checks.layers(around, d_image, alpha)
        return self._composition("compose.backward", around, alpha, d_image, loss)

    def adam_step(
        self, param: torch.Tensor, grad: torch.Tensor, adam: DenseAdam, threads: int = 0
    ) -> None:
        checks.check_adam(param, grad, adam)
        gpu, shared = self.gpu, adam.exp_avg_sq.shape != param.shape
        count = len(param) if shared else param.numel()
        uniform, rates = adam_uniform(Workspace(gpu), "a tensor", adam, count, param[:1].numel())
        buffers = {
            "parameter": gpu.upload(param.detach().numpy()),
            "exp_avg": gpu.upload(adam.exp_avg.numpy()),
            "exp_avg_sq": gpu.upload(adam.exp_avg_sq.numpy()),
        }
        gpu.run(
            "adam.rows" if shared else "adam.elements",
            blocks(count),
            adam=uniform,
            rates=rates,
            gradient=gpu.upload(grad.detach().numpy()),
            **buffers,
        )
        self._fetch(buffers["parameter"], param)
        self._fetch(buffers["exp_avg"], adam.exp_avg)
        self._fetch(buffers["exp_avg_sq"], adam.exp_avg_sq)

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
        count = len(means)
        tensors = {"means": means, "log_scales": log_scales, "quats": quats}
        gradients = {"means": d_means, "log_scales": d_means, "quats": d_quats}
        sections = {name: layout.GEOMETRY[name] for name in tensors}
        geometry = self._sections(sections, _arrays(tensors), count)
        moments = {
            "mean_avg": adam.mean_avg,
            "mean_avg_sq": adam.mean_avg_sq,
            "rotation_avg": adam.rotation_avg,
            "rotation_avg_sq": adam.rotation_avg_sq,
        }
        buffers = {name: self.gpu.upload(tensor.numpy()) for name, tensor in moments.items()}
        self.gpu.run(
            "frame_adam",
            blocks(count),
            adam=frame_uniform(Workspace(self.gpu), adam, count),
            geometry=geometry,
            gradients=self._sections(sections, _arrays(gradients), count),
            **buffers,
        )
        found = self._read_sections(sections, geometry, count)
        means.detach().copy_(found["means"])
        quats.detach().copy_(found["quats"])
        for name, tensor in moments.items():
            self._fetch(buffers[name], tensor)

    def _scene(self, parameters: Parameters) -> rasterise.Scene:
        """The parameters on the device. Those of the last call are copied once: usually, a scene is
        rendered from many views."""
        key = tuple((p.data_ptr(), p._version, p.shape) for p in parameters)
        if self._last is None or self._last[0] != key:
            names = ("means", "log_scales", "quats", "opacity_logits")
            arrays = dict(zip(names, (p.numpy() for p in parameters[:4]), strict=True))
            count, sh = len(parameters[0]), parameters[4]
            scene = rasterise.Scene(
                count,
                sh.shape[1],
                self._sections(layout.GEOMETRY, arrays, count),
                self.gpu.upload(sh.numpy(), what="the SH coefficients"),
            )
            # The tensors are kept, so that others cannot get their addresses.
            self._last = key, scene, parameters
        return self._last[1]

    def _sections(
        self, sections: Mapping[str, int], arrays: Mapping[str, NDArray[np.float32]], count: int
    ) -> Buffer:
        """A buffer of the arrays, one after another."""
        whole = np.concatenate([arrays[name].reshape(-1) for name in sections])
        return self.gpu.upload(whole, what=f"{count} Gaussians")

    def _read_sections(
        self, sections: Mapping[str, int], buffer: Buffer, count: int
    ) -> dict[str, torch.Tensor]:
        """The tensors (N, width) of a buffer's sections."""
        whole = torch.from_numpy(self.gpu.read(buffer, np.float32, layout.floats(sections) * count))
        return {
            name: whole[at : at + size].view(count, sections[name])
            for name, (at, size) in layout.offsets(sections, count).items()
        }

    def _fetch(self, buffer: Buffer, tensor: torch.Tensor) -> None:
        """Copy a buffer into a tensor."""
        found = self.gpu.read(buffer, tensor.detach().numpy().dtype, tensor.numel())
        tensor.detach().copy_(torch.from_numpy(found).view(tensor.shape))

    def _composition(
        self,
        kernel: str,
        around: Surroundings,
        alpha: torch.Tensor,
        values: torch.Tensor,
        loss: AlphaChangeLoss,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        gpu, pixels = self.gpu, alpha.numel()
        result, d_alpha = gpu.empty(12 * pixels), gpu.empty(4 * pixels)
        gpu.run(
            kernel,
            blocks(pixels),
            layers=layers_uniform(gpu, around, pixels, loss),
            alpha=gpu.upload(alpha.numpy()),
            values=gpu.upload(values.numpy()),
            result=result,
            d_alpha=d_alpha,
            **upload_layers(gpu, around),
        )
        images = (
            torch.from_numpy(gpu.read(result, np.float32, 3 * pixels)).view(values.shape),
            torch.from_numpy(gpu.read(d_alpha, np.float32, pixels)).view(alpha.shape),
        )
        return images


def _arrays(tensors: Mapping[str, torch.Tensor]) -> dict[str, NDArray[np.float32]]:
    return {name: tensor.detach().numpy() for name, tensor in tensors.items()}
