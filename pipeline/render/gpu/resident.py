"""Training on the device: only the number of pairs and the loss are read back in a step."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from pipeline.render.gpu import layout, rasterise
from pipeline.render.gpu.adam import adam_step, frame_adam
from pipeline.render.gpu.device import Buffer, Gpu, blocks
from pipeline.render.gpu.loss import LossImage, LossSums, compose, l1_ssim, upload_layers
from pipeline.render.gpu.memory import memory_line
from pipeline.render.gpu.primitives import sum_rows
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.resident import (
    Optimised,
    ResidentImage,
    ResidentStep,
    ResidentTraining,
    StepResult,
    TrainingSize,
)
from pipeline.render.types import AdamRates

# The bytes of the training images that are kept on the device. Others are copied at every use.
IMAGE_CACHE = 2 << 30


@dataclass(frozen=True)
class _Image:
    """A training image on the device, with the layers of its surroundings."""

    photograph: LossImage
    layers: dict[str, Buffer]

    @property
    def size(self) -> int:
        """The bytes of its buffers."""
        planes = [*self.photograph.buffers.values(), *self.layers.values()]
        return sum(int(buffer.size) for buffer in planes)


class _Images:
    """The training images that were used last."""

    def __init__(self, gpu: Gpu):
        self.gpu = gpu
        self._cache: OrderedDict[tuple[int, ...], _Image] = OrderedDict()
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
    image: rasterise.Image

    @property
    def alpha(self) -> Tensor:
        return self.image.plane(self.gpu, 0)

    @property
    def depth(self) -> Tensor:
        return self.image.plane(self.gpu, 1)


class GpuTraining(ResidentTraining):
    """See ``ResidentTraining``."""

    def __init__(self, gpu: Gpu):
        self.gpu, self.space, self.images = gpu, Workspace(gpu), _Images(gpu)
        self.scene = rasterise.Scene(0, 1, gpu.empty(0), gpu.empty(0))
        self.buffers: dict[str, Buffer] = {}
        self.embedding_size = 0

    def memory_line(self, size: TrainingSize) -> str:
        return memory_line(self.gpu, size, IMAGE_CACHE)

    def load(self, optimised: Optimised) -> None:
        parameters, count = optimised.parameters, len(optimised.last)
        sh, geometry = parameters["sh"], layout.join(layout.GEOMETRY, parameters)
        self.scene = rasterise.Scene(
            count, sh.shape[1], self._fill("geometry", geometry), self._fill("sh", sh.numpy())
        )
        appearance = parameters.get("appearance")
        self.embedding_size = 0 if appearance is None else appearance.shape[1]
        self.buffers = {
            name: self._fill(name, tensor.numpy()) for name, tensor in _others(optimised).items()
        }

    def store(self, optimised: Optimised) -> None:
        parameters, scene = optimised.parameters, self.scene
        found = layout.split(layout.GEOMETRY, scene.geometry, self.gpu, scene.count)
        for name, tensor in found.items():
            parameters[name].copy_(tensor.view(parameters[name].shape))
        layout.fetch(self.gpu, scene.sh, parameters["sh"])
        for name, tensor in _others(optimised).items():
            layout.fetch(self.gpu, self.buffers[name], tensor)

    def step(self, step: ResidentStep) -> StepResult:
        gpu, space, scene, camera = self.gpu, self.space, self.scene, step.camera
        size = camera.width, camera.height
        packed = layout.pack_view(camera, step.options, scene.count, scene.coefficients)
        view = space.write_uniform("view", packed.tobytes())
        appearance = self._appearance(step)
        if appearance is not None:
            space.run("appearance.show", blocks(scene.count), **appearance)
        projection = rasterise.project(space, scene, view, size)
        lists = rasterise.list_pairs(space, projection)
        image = rasterise.blend(space, lists)
        target = self.images.get(step.image)
        d_planes = space.get("gradients of alpha and depth", 8 * size[0] * size[1])
        gpu.clear(d_planes)
        d_color, loss = self._loss(step, target, image, d_planes)
        self._add_other_losses(step, image, d_planes)
        more = self._moments("sh") | {"last_step": self.buffers["last"]}
        if step.camera_gradients:
            size_of_rows = 4 * layout.CAMERA_PARAMETERS * scene.count
            more["d_camera"] = space.get("camera gradients", size_of_rows)
        rates = step.adam["sh"]
        gradients = rasterise.backward(space, image, d_color, d_planes, rates, **more)
        if appearance is not None:
            space.run("appearance.hide", blocks(scene.count), **appearance)
            space.run("appearance.gradient", blocks(scene.count), **appearance)
        self._observe(step, projection, gradients)
        self._optimise(step.adam, gradients)
        error, ssim, squared = loss.values(space)
        cameras = None
        if step.camera_gradients:
            cameras = rasterise.camera_gradients(space, more["d_camera"], scene.count)
        return StepResult(
            loss=(1 - step.ssim_weight) * error + step.ssim_weight * (1 - ssim),
            squared_error=squared,
            num_visible=lists.num_visible,
            num_dropped=lists.num_dropped,
            camera=cameras,
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
        space, pixels = self.space, step.camera.width * step.camera.height
        size = step.camera.width, step.camera.height
        weights = step.ssim_weight, step.l2_weight, step.image.gain
        if step.image.surroundings is None:
            loss = l1_ssim(space, image.color, target.photograph, size, *weights)
            return loss.gradient, loss
        composed = space.get("composed image", 12 * pixels)
        around = target.layers, pixels, step.alpha_loss
        compose(
            space, "compose.compose", *around, alpha=image.planes, values=image.color,
            result=composed,
        )  # fmt: skip
        loss = l1_ssim(space, composed, target.photograph, size, *weights)
        d_color = space.get("gradient of the part", 12 * pixels)
        compose(
            space, "compose.backward", *around, alpha=image.planes, values=loss.gradient,
            result=d_color, d_alpha=d_planes,
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
        found = step.losses(_Planes(self.gpu, image))
        for part, gradient in zip(both, found, strict=True):
            if gradient is not None:
                part += gradient.numpy()
        self.gpu.write(d_planes, both)

    def _moments(self, name: str) -> dict[str, Buffer]:
        first, second = self.buffers[f"first {name}"], self.buffers[f"second {name}"]
        return {"exp_avg": first, "exp_avg_sq": second}

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
        return tuple(sum_rows(self.space, rows, count, size).tolist())

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

    def _optimise(self, rates: Mapping[str, AdamRates], gradients: Buffer) -> None:
        """Update all parameters but SH."""
        space, scene, buffers = self.space, self.scene, self.buffers
        if "frames" in rates:
            frame_adam(
                space,
                rates["frames"],
                scene.count,
                gradients=gradients,
                geometry=scene.geometry,
                mean_avg=buffers["first means"],
                mean_avg_sq=buffers["second means"],
                rotation_avg=buffers["first quats"],
                rotation_avg_sq=buffers["second quats"],
            )
        if "appearance" in buffers:
            width = 3 * self.embedding_size
            adam_step(
                space,
                "appearance",
                rates["appearance"],
                (scene.count, width),
                shared=False,
                gradient=space.get("gradients of the appearance", 4 * width * scene.count),
                parameter=buffers["appearance"],
                **self._moments("appearance"),
            )
        for name, (at, _) in layout.offsets(layout.GEOMETRY, scene.count).items():
            if name not in rates:
                continue
            adam_step(
                space,
                name,
                rates[name],
                (scene.count, layout.GEOMETRY[name]),
                shared=name in ("means", "quats"),
                at=at,
                gradient=gradients,
                parameter=scene.geometry,
                **self._moments(name),
            )


def _others(optimised: Optimised) -> dict[str, Tensor]:
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
