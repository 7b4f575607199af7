"""Training on the device: only the number of pairs and the loss are read back in a step."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import torch

from pipeline.render.gpu import layout, rasterise
from pipeline.render.gpu.adam import adam_uniform, frame_uniform, sh_options
from pipeline.render.gpu.device import Buffer, Gpu, blocks
from pipeline.render.gpu.loss import (
    LossImage,
    LossSums,
    l1_ssim,
    layers_uniform,
    upload_layers,
)
from pipeline.render.gpu.memory import memory_line
from pipeline.render.gpu.reduce import camera_gradients, sum_rows
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
    """A training image on the device, with the layers of its surroundings."""

    photograph: LossImage
    layers: dict[str, Buffer]

    @property
    def size(self) -> int:
        """Bytes."""
        planes = [*self.photograph.buffers.values(), *self.layers.values()]
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
        around = image.surroundings
        found = _Image(
            LossImage.upload(self.gpu, image.target, image.mask),
            {} if around is None else upload_layers(self.gpu, around),
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
        self.appearance_size = 0  # numbers of the parameter

    def memory_line(self, size: TrainingSize) -> str:
        return memory_line(self.gpu, size, IMAGE_CACHE)

    def load(self, optimised: Optimised) -> None:
        parameters, count = optimised.parameters, len(optimised.last)
        whole = np.concatenate([parameters[n].numpy().reshape(-1) for n in layout.GEOMETRY])
        sh = parameters["sh"]
        self.scene = rasterise.Scene(
            count, sh.shape[1], self._fill("geometry", whole), self._fill("sh", sh.numpy())
        )
        appearance = parameters.get("appearance")
        self.appearance_size = 0 if appearance is None else appearance.numel()
        self.buffers = {
            name: self._fill(name, tensor.numpy()) for name, tensor in _others(optimised).items()
        }

    def store(self, optimised: Optimised) -> None:
        parameters, count = optimised.parameters, self.scene.count
        whole = self.gpu.read(
            self.scene.geometry, np.float32, layout.floats(layout.GEOMETRY) * count
        )
        for name, (at, size) in layout.offsets(layout.GEOMETRY, count).items():
            parameters[name].view(-1).copy_(torch.from_numpy(whole[at : at + size]))
        tensors = _others(optimised) | {"sh": parameters["sh"]}
        for name, tensor in tensors.items():
            buffer = self.scene.sh if name == "sh" else self.buffers[name]
            found = self.gpu.read(buffer, tensor.numpy().dtype, tensor.numel())
            tensor.copy_(torch.from_numpy(found).view(tensor.shape))

    def step(self, step: ResidentStep) -> StepResult:
        gpu, space, scene, camera = self.gpu, self.space, self.scene, step.camera
        size = camera.width, camera.height
        packed = layout.pack_view(camera, step.options, scene.count, scene.coefficients)
        view = space.write_uniform("view", packed.tobytes())
        appearance = self._appearance(step)
        if appearance is not None:
            space.run("appearance.show", blocks(scene.count), **appearance)
        projection = rasterise.project(gpu, space, scene, view, size)
        lists = rasterise.list_pairs(gpu, space, projection, scene.count)
        image = rasterise.blend(gpu, space, projection, lists)
        target = self.images.get(step.image)
        d_planes = space.get("gradients of alpha and depth", 8 * size[0] * size[1])
        gpu.clear(d_planes)
        d_color, loss = self._loss(step, target, image, d_planes)
        self._add_other_losses(step, image, d_planes)
        slots = rasterise.blend_backward(gpu, space, projection, lists, image, d_color, d_planes)
        gradients, d_camera = self._project_backward(step, projection, lists, slots)
        if appearance is not None:
            space.run("appearance.hide", blocks(scene.count), **appearance)
            space.run("appearance.gradient", blocks(scene.count), **appearance)
        self._observe(step, projection, gradients)
        self._optimise(step.adam, gradients)
        error, ssim, squared = loss.values(gpu, space)
        return StepResult(
            loss=(1 - step.ssim_weight) * error + step.ssim_weight * (1 - ssim),
            squared_error=squared,
            num_visible=lists.num_visible,
            num_dropped=lists.num_dropped,
            camera=(
                None if d_camera is None else camera_gradients(gpu, space, d_camera, scene.count)
            ),
            embedding=self._embedding_gradient(step),
        )

    def _fill(self, name: str, array: np.ndarray) -> Buffer:
        buffer = self.space.get(name, array.nbytes)
        self.gpu.write(buffer, array)
        return buffer

    def _loss(
        self, step: ResidentStep, target: _Image, image: rasterise.Image, d_planes: Buffer
    ) -> tuple[Buffer, LossSums]:
        """The gradient on the colours, and the loss; with surroundings, the gradient on alpha as
        well, in ``d_planes``."""
        gpu, space = self.gpu, self.space
        size = step.camera.width, step.camera.height
        pixels, around = size[0] * size[1], step.image.surroundings
        weights = step.ssim_weight, step.l2_weight, step.image.gain
        if around is None:
            loss = l1_ssim(gpu, space, image.color, target.photograph, size, *weights)
            return loss.gradient, loss
        layers = {
            **target.layers,
            "alpha": image.planes,
            "layers": layers_uniform(gpu, around, pixels, step.alpha_loss),
        }
        composed = space.get("composed image", 12 * pixels)
        gpu.run("compose.compose", blocks(pixels), values=image.color, result=composed, **layers)
        loss = l1_ssim(gpu, space, composed, target.photograph, size, *weights)
        d_color = space.get("gradient of the part", 12 * pixels)
        gpu.run(
            "compose.backward", blocks(pixels), values=loss.gradient, result=d_color,
            d_alpha=d_planes, **layers,
        )  # fmt: skip
        return d_color, loss

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
        space, adam = self.space, step.adam
        nothing = torch.empty(0)
        sh_adam = ShAdam(
            nothing, nothing, nothing, adam.rates["sh0"], adam.rates["shN"], adam.step,
            adam.beta1, adam.beta2, adam.eps,
        )  # fmt: skip
        more = {
            "exp_avg": self.buffers["first sh"],
            "exp_avg_sq": self.buffers["second sh"],
            "last_step": self.buffers["last"],
        }
        if step.camera_gradients:
            size = 4 * layout.CAMERA_PARAMETERS * self.scene.count
            more["d_camera"] = space.get("camera gradients", size)
        options = sh_options(space, sh_adam, step.camera_gradients)
        gradients = rasterise.project_backward(
            space, self.scene, projection, lists, slots, options, **more
        )
        return gradients, more.get("d_camera")

    def _appearance(self, step: ResidentStep) -> dict[str, Buffer] | None:
        """The buffers of appearance.wgsl, if colours depend on the photograph."""
        if step.embedding is None:
            return None
        space, scene, size = self.space, self.scene, len(step.embedding)
        colors_at, _ = layout.offsets(layout.GRADIENTS, scene.count)["colors"]
        sizes = scene.count, size, scene.coefficients, colors_at
        weights = np.array(step.embedding, np.float32)
        return {
            "appearance": space.uniform("sizes of the appearance", "IIII", *sizes),
            "weights": space.write_uniform("embedding", weights.tobytes()),
            "values": self.buffers["appearance"],
            "sh": scene.sh,
            "colours": space.get("colours", 24 * scene.count),
            "gradients": self._gradients(),
            "d_values": space.get("gradients of the appearance", 12 * size * scene.count),
            "d_weights": space.get("gradients of the embedding", 4 * size * scene.count),
        }

    def _gradients(self) -> Buffer:
        return self.space.get("gradients", 4 * layout.floats(layout.GRADIENTS) * self.scene.count)

    def _embedding_gradient(self, step: ResidentStep) -> tuple[float, ...] | None:
        if step.embedding is None:
            return None
        size, count = len(step.embedding), self.scene.count
        rows = self.space.get("gradients of the embedding", 4 * size * count)
        return tuple(sum_rows(self.gpu, self.space, rows, count, size).tolist())

    def _observe(
        self, step: ResidentStep, projection: rasterise.Projection, gradients: Buffer
    ) -> None:
        count = self.scene.count
        at, _ = layout.offsets(layout.GRADIENTS, count)["means2d"]
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
        if "appearance" in self.buffers:
            self._step_appearance(adam)
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

    def _step_appearance(self, adam: GaussianAdam) -> None:
        """At the rate of the constant SH coefficient."""
        nothing, parameter = torch.empty(0), self.buffers["appearance"]
        dense = DenseAdam(
            nothing, nothing, adam.rates["sh0"], adam.step, adam.beta1, adam.beta2, adam.eps
        )
        count = self.appearance_size
        uniform, rates = adam_uniform(self.space, "appearance", dense, count, 1)
        self.space.run(
            "adam.elements",
            blocks(count),
            adam=uniform,
            rates=rates,
            gradient=self.space.get("gradients of the appearance", 4 * count),
            parameter=parameter,
            exp_avg=self.buffers["first appearance"],
            exp_avg_sq=self.buffers["second appearance"],
        )


def _others(optimised: Optimised) -> dict[str, torch.Tensor]:
    """All tensors but the parameters of the rasterizer, by the names of their buffers."""
    tensors = {f"first {name}": tensor for name, tensor in optimised.first.items()}
    tensors |= {f"second {name}": tensor for name, tensor in optimised.second.items()}
    if (appearance := optimised.parameters.get("appearance")) is not None:
        tensors["appearance"] = appearance
    return tensors | {
        "last": optimised.last,
        "gradient_sum": optimised.gradient_sum,
        "seen": optimised.seen,
    }
