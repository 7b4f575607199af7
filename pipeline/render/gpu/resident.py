"""Training on the device: only the number of pairs and the loss are read back in a step."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import torch

from pipeline.render.gpu import layout, rasterise
from pipeline.render.gpu.adam import adam_uniform, frame_uniform, sh_options
from pipeline.render.gpu.device import Buffer, Gpu, blocks
from pipeline.render.gpu.memory import memory_line
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.resident import (
    GaussianAdam,
    Optimised,
    ResidentImage,
    ResidentStep,
    ResidentTraining,
    StepResult,
    TrainingSize,
)
from pipeline.render.types import DenseAdam, FrameAdam, ShAdam

# Training images on the device, bytes; images beyond are copied at every use.
IMAGE_CACHE = 2 << 30


@dataclass(frozen=True)
class _Image:
    target: Buffer
    mask: Buffer | None
    count: int  # of unmasked values
    is_bytes: bool
    layers: dict[str, Buffer]  # of its surroundings

    @property
    def size(self) -> int:
        """Bytes."""
        planes = [self.target, *self.layers.values(), *([self.mask] if self.mask else [])]
        return sum(int(buffer.size) for buffer in planes)


class _Images:
    """The training images that were used last."""

    def __init__(self, gpu: Gpu):
        self.gpu = gpu
        self._cache: OrderedDict[tuple[int, int], _Image] = OrderedDict()
        self._size = 0

    def get(self, image: ResidentImage) -> _Image:
        if image.key is not None and image.key in self._cache:
            self._cache.move_to_end(image.key)
            return self._cache[image.key]
        mask = image.mask
        ignored = 0 if mask is None else int((mask != 0).sum())
        found = _Image(
            self.gpu.upload(image.target.contiguous().numpy(), what="a training image"),
            None if mask is None else self.gpu.upload(mask.contiguous().numpy()),
            image.target.numel() - 3 * ignored,
            image.target.dtype == torch.uint8,
            rasterise.upload_layers(self.gpu, image.surroundings) if image.surroundings else {},
        )
        if image.key is not None:
            self._cache[image.key] = found
            self._size += found.size
            while self._size > IMAGE_CACHE:
                self._size -= self._cache.popitem(last=False)[1].size
        return found


@dataclass(frozen=True)
class _Planes:
    """See ``resident.Planes``: copied to the CPU when they are read."""

    gpu: Gpu
    planes: Buffer
    shape: tuple[int, int]

    @property
    def alpha(self) -> torch.Tensor:
        return self._plane(0)

    @property
    def depth(self) -> torch.Tensor:
        return self._plane(1)

    def _plane(self, number: int) -> torch.Tensor:
        pixels = self.shape[0] * self.shape[1]
        found = self.gpu.read(self.planes, np.float32, pixels, 4 * pixels * number)
        return torch.from_numpy(found).view(self.shape)


class GpuTraining(ResidentTraining):
    """See ``ResidentTraining``."""

    def __init__(self, gpu: Gpu):
        self.gpu, self.space, self.images = gpu, Workspace(gpu), _Images(gpu)
        self.scene = rasterise.Scene(0, 1, gpu.empty(0), gpu.empty(0))
        self.buffers: dict[str, Buffer] = {}

    def memory_line(self, size: TrainingSize) -> str:
        return memory_line(self.gpu, size, IMAGE_CACHE)

    def load(self, optimised: Optimised) -> None:
        parameters, count = optimised.parameters, len(optimised.last)
        whole = np.concatenate([parameters[n].numpy().reshape(-1) for n in layout.GEOMETRY])
        sh = parameters["sh"]
        self.scene = rasterise.Scene(
            count, sh.shape[1], self._fill("geometry", whole), self._fill("sh", sh.numpy())
        )
        self.buffers = {
            name: self._fill(name, tensor.numpy()) for name, tensor in _moments(optimised).items()
        }

    def store(self, optimised: Optimised) -> None:
        parameters, count = optimised.parameters, self.scene.count
        whole = self.gpu.read(
            self.scene.geometry, np.float32, layout.floats(layout.GEOMETRY) * count
        )
        for name, (at, size) in layout.offsets(layout.GEOMETRY, count).items():
            parameters[name].view(-1).copy_(torch.from_numpy(whole[at : at + size]))
        tensors = _moments(optimised) | {"sh": parameters["sh"]}
        for name, tensor in tensors.items():
            buffer = self.scene.sh if name == "sh" else self.buffers[name]
            found = self.gpu.read(buffer, tensor.numpy().dtype, tensor.numel())
            tensor.copy_(torch.from_numpy(found).view(tensor.shape))

    def step(self, step: ResidentStep) -> StepResult:
        gpu, space, scene, camera = self.gpu, self.space, self.scene, step.camera
        size = camera.width, camera.height
        packed = layout.pack_view(camera, step.options, scene.count, scene.coefficients)
        view = space.write_uniform("view", packed.tobytes())
        projection = rasterise.project(gpu, space, scene, view, size)
        lists = rasterise.list_pairs(gpu, space, projection, scene.count)
        image = rasterise.blend(gpu, space, projection, lists)
        target = self.images.get(step.image)
        d_planes = space.get("gradients of alpha and depth", 8 * size[0] * size[1])
        gpu.clear(d_planes)
        d_color, sums = self._loss(step, target, image, d_planes)
        self._add_other_losses(step, image, d_planes)
        slots = rasterise.blend_backward(gpu, space, projection, lists, image, d_color, d_planes)
        gradients, d_camera = self._project_backward(step, projection, lists, slots)
        self._observe(step, projection, gradients)
        self._optimise(step.adam, gradients)
        rows = 3 * np.prod(layout.tiles_of(*size))
        error, ssim, squared, _ = rasterise.sum_rows(gpu, space, sums, int(rows), 4) / max(
            1, target.count
        )
        loss = (1 - step.ssim_weight) * error + step.ssim_weight * (1 - ssim)
        return StepResult(
            float(loss) if target.count else 0.0,
            float(squared),
            lists.num_visible,
            lists.num_dropped,
            None if d_camera is None else rasterise.camera_gradients(
                gpu, space, d_camera, scene.count
            ),
        )  # fmt: skip

    def _fill(self, name: str, array: np.ndarray) -> Buffer:
        buffer = self.space.get(name, array.nbytes)
        self.gpu.write(buffer, array)
        return buffer

    def _loss(
        self, step: ResidentStep, target: _Image, image: rasterise.Image, d_planes: Buffer
    ) -> tuple[Buffer, Buffer]:
        """The gradient on the colours, and the sums of the loss's workgroups; with surroundings,
        the gradient on alpha as well, in ``d_planes``."""
        gpu, space = self.gpu, self.space
        size = step.camera.width, step.camera.height
        pixels, tiles = size[0] * size[1], layout.tiles_of(*size)
        around, rendered = step.image.surroundings, image.color
        d_image = space.get("gradient of the image", 12 * pixels)
        layers = target.layers
        if around is not None:
            rendered = space.get("composed image", 12 * pixels)
            layers = {**layers, "alpha": image.planes}
            layers["layers"] = rasterise.layers_uniform(gpu, around, pixels, step.alpha_loss)
            gpu.run(
                "compose.compose", blocks(pixels), values=image.color, result=rendered, **layers
            )
        arguments = {
            "loss": rasterise.loss_uniform(
                gpu, size, max(1, target.count), step.ssim_weight, step.l2_weight,
                is_bytes=target.is_bytes, masked=target.mask is not None, gain=step.image.gain,
            ),
            "rendered": rendered,
            "target_words": target.target,
            "derivatives": space.get("derivatives of SSIM", 36 * pixels),
            "gradient": d_image,
            "sums": space.get("sums of the loss", 16 * 3 * tiles[0] * tiles[1]),
        }  # fmt: skip
        if target.mask is not None:
            arguments["mask"] = target.mask
        gpu.run("loss.forward", (*tiles, 3), **arguments)
        gpu.run("loss.backward", (*tiles, 3), **arguments)
        if around is None:
            return d_image, arguments["sums"]
        d_color = space.get("gradient of the part", 12 * pixels)
        gpu.run(
            "compose.backward", blocks(pixels), values=d_image, result=d_color, d_alpha=d_planes,
            **layers,
        )  # fmt: skip
        return d_color, arguments["sums"]

    def _add_other_losses(
        self, step: ResidentStep, image: rasterise.Image, d_planes: Buffer
    ) -> None:
        """Add to the gradients on alpha and depth (2, H, W)."""
        if step.losses is None:
            return
        shape = step.camera.height, step.camera.width
        both = self.gpu.read(d_planes, np.float32, 2 * shape[0] * shape[1]).reshape(2, *shape)
        found = step.losses(_Planes(self.gpu, image.planes, shape))
        for part, gradient in zip(both, found, strict=True):
            if gradient is not None:
                part += gradient.numpy()
        self.gpu.write(d_planes, both)

    def _project_backward(
        self,
        step: ResidentStep,
        projection: rasterise.Projection,
        lists: rasterise.Lists,
        slots: Buffer,
    ) -> tuple[Buffer, Buffer | None]:
        """The gradients of all but SH, which are updated, and those of the camera."""
        space, scene, adam = self.space, self.scene, step.adam
        gradients = space.get("gradients", 4 * layout.floats(layout.GRADIENTS) * scene.count)
        nothing = torch.empty(0)
        sh_adam = ShAdam(
            nothing, nothing, nothing, adam.rates["sh0"], adam.rates["shN"], adam.step,
            adam.beta1, adam.beta2, adam.eps,
        )  # fmt: skip
        d_camera = None
        if step.camera_gradients:
            d_camera = space.get("camera gradients", 4 * layout.CAMERA_PARAMETERS * scene.count)
        space.run(
            "project_backward",
            blocks(scene.count),
            view=projection.view,
            options=sh_options(space, sh_adam, step.camera_gradients),
            geometry=scene.geometry,
            sh=scene.sh,
            records=projection.records,
            tile_counts=projection.tile_counts,
            slot_of=lists.slots,
            slots=slots,
            gradients=gradients,
            exp_avg=self.buffers["first sh"],
            exp_avg_sq=self.buffers["second sh"],
            last_step=self.buffers["last"],
            **({} if d_camera is None else {"d_camera": d_camera}),
        )
        return gradients, d_camera

    def _observe(
        self, step: ResidentStep, projection: rasterise.Projection, gradients: Buffer
    ) -> None:
        count = self.scene.count
        name = "means2d_abs" if step.absolute else "means2d"
        at, _ = layout.offsets(layout.GRADIENTS, count)[name]
        half = 0.5 * step.camera.width, 0.5 * step.camera.height
        self.space.run(
            "observe",
            blocks(count),
            options=self.space.uniform("options of statistics", "IIff", count, at, *half),
            gradients=gradients,
            radii=projection.radii,
            gradient_sum=self.buffers["gradient_sum"],
            seen=self.buffers["seen"],
        )

    def _optimise(self, adam: GaussianAdam, gradients: Buffer) -> None:
        """Update all parameters but SH."""
        count, nothing = self.scene.count, torch.empty(0)
        dense = ["log_scales", "opacity_logits"]
        if adam.frames:
            frame = FrameAdam(
                nothing, nothing, nothing, nothing, adam.rates["means"], adam.rates["quats"],
                adam.step, adam.beta1, adam.beta2, adam.eps,
            )  # fmt: skip
            self.space.run(
                "frame_adam",
                blocks(count),
                adam=frame_uniform(self.space, frame, count),
                gradients=gradients,
                geometry=self.scene.geometry,
                mean_avg=self.buffers["first means"],
                mean_avg_sq=self.buffers["second means"],
                rotation_avg=self.buffers["first quats"],
                rotation_avg_sq=self.buffers["second quats"],
            )
        else:
            dense += ["means", "quats"]
        for name in dense:
            at, numbers = layout.offsets(layout.GEOMETRY, count)[name]
            rows = name in ("means", "quats")
            each = layout.GEOMETRY[name]
            eps = adam.means_eps if name == "means" else adam.eps
            dense_adam = DenseAdam(
                nothing, nothing, adam.rates[name], adam.step, adam.beta1, adam.beta2, eps
            )
            elements = count if rows else numbers
            uniform, rates = adam_uniform(self.space, name, dense_adam, elements, each, at)
            self.space.run(
                "adam.rows" if rows else "adam.elements",
                blocks(elements),
                adam=uniform,
                rates=rates,
                gradient=gradients,
                parameter=self.scene.geometry,
                exp_avg=self.buffers[f"first {name}"],
                exp_avg_sq=self.buffers[f"second {name}"],
            )


def _moments(optimised: Optimised) -> dict[str, torch.Tensor]:
    """All tensors but the parameters, by the names of their buffers."""
    tensors = {f"first {name}": tensor for name, tensor in optimised.first.items()}
    tensors |= {f"second {name}": tensor for name, tensor in optimised.second.items()}
    return tensors | {
        "last": optimised.last,
        "gradient_sum": optimised.gradient_sum,
        "seen": optimised.seen,
    }
