"""Training on the device. The processor records steps without waiting for them, and reads the
results of many at once.

The arrays of pairs have room for a number of pairs that the steps before suggest. A step with more
pairs changes nothing, nor do the steps after it (admit.wgsl); when the processor reads this, it
makes the arrays larger and records these steps again. So results do not depend on the room.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render.checks import Parameters
from pipeline.render.gpu import layout, rasterise
from pipeline.render.gpu.adam import adam_step, update_gaussians
from pipeline.render.gpu.device import Buffer, Gpu, blocks
from pipeline.render.gpu.loss import LossImage, LossSums, compose, l1_ssim, upload_layers
from pipeline.render.gpu.memory import PAIRS_PER_GAUSSIAN, memory_line
from pipeline.render.gpu.primitives import add_partial_sums, partial_sums, sum_blocks
from pipeline.render.gpu.rasterise import Totals
from pipeline.render.gpu.scene_cache import SceneCache
from pipeline.render.gpu.trained import Trained
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.resident import (
    Optimised,
    Part,
    ResidentImage,
    ResidentStep,
    ResidentTraining,
    StepResult,
    TrainingSize,
)

# The bytes of the training images that are kept on the device. Others are copied at every use.
IMAGE_CACHE = 2 << 30
# The steps whose results are read at once at the latest, and the words of their results at least.
MAX_RECORDED, RESULT_WORDS = 32, 1 << 16
# The pairs for which there is room at least. Beyond it, the room is ``ROOM`` times the largest
# number of pairs in ``RECENT_STEPS``; it stays while it is between the other two factors.
MIN_CAPACITY, RECENT_STEPS = 1 << 16, 512
LEAST_ROOM, ROOM, MOST_ROOM = 1.1, 1.3, 2.0


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
class _Recorded:
    """A step whose result has not been read.

    Attributes:
        loss: The loss on the device.
        at: The first word of each part of the result in the buffer of results: the totals, then
            sums of blocks of rows of the loss, of the camera and of the embedding.
        end: The word after the last.
    """

    step: ResidentStep
    loss: LossSums
    at: Mapping[str, int]
    end: int


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
    """See ``ResidentTraining``.

    Args:
        scenes: The scene that the backend's operators render.
    """

    def __init__(self, gpu: Gpu, scenes: SceneCache):
        self.gpu, self.space, self.images = gpu, Workspace(gpu), _Images(gpu)
        self.scenes = scenes
        self.trained = Trained(self.space)
        self.scene = rasterise.Scene(0, 1, gpu.empty(0), gpu.empty(0))
        self.stopped = gpu.empty(4, what="stopped")
        self._recorded: list[_Recorded] = []
        self._results: list[StepResult] = []
        self._dropped = 0  # The sum of the steps whose results have been read.
        self._capacity = 0  # The pairs for which the arrays of a step have room.
        self._pairs: deque[int] = deque(maxlen=RECENT_STEPS)

    def memory_line(self, size: TrainingSize) -> str:
        return memory_line(self.gpu, size, IMAGE_CACHE)

    def lend(self, parameters: Parameters) -> None:
        self._read_results()
        self.scenes.lend(parameters, self.scene)

    def load(self, optimised: Optimised, part: Part = Part.ALL) -> None:
        self._read_results()
        self.trained.load(optimised, part)
        self._set_scene()

    def load_moments(self, optimised: Optimised, name: str) -> None:
        self._read_results()
        self.trained.load_moments(optimised, name)

    def select(self, rows: Tensor, blank: Tensor, row: Optimised) -> None:
        self._read_results()
        self.trained.select(rows, blank, row)
        self._set_scene()

    def bad_colors(self) -> Tensor:
        self._read_results()
        return self.trained.bad_colors()

    def store(self, optimised: Optimised, part: Part = Part.ALL) -> None:
        self._read_results()
        self.trained.store(optimised, part)

    def _set_scene(self) -> None:
        """Render the Gaussians that ``trained`` has, with room for their pairs."""
        self.scenes.take_back()
        before, self.scene = self.scene.count, self.trained.scene
        count = self.scene.count
        if not self._pairs:
            self._set_capacity(0, PAIRS_PER_GAUSSIAN * count)
        elif count > before:
            self._set_capacity(max(self._pairs), self._capacity * count // max(before, 1))

    def step(self, step: ResidentStep) -> None:
        self.scenes.take_back()
        if self._recorded:
            end = self._recorded[-1].end + sum(self._sizes(step).values())
            if end > RESULT_WORDS or len(self._recorded) == MAX_RECORDED:
                self._read_results()
        self._record(step)

    def results(self) -> list[StepResult]:
        self._read_results()
        found, self._results = self._results, []
        return found

    def _record(self, step: ResidentStep) -> None:
        """Record and start the kernels of a step."""
        gpu, space, scene, camera = self.gpu, self.space, self.scene, step.camera
        size = camera.width, camera.height
        packed = layout.pack_view(camera, step.options, scene.count, scene.coefficients)
        view = space.write_uniform("view", packed.tobytes())
        appearance = self._appearance(step)
        if appearance is not None:
            space.run("appearance.show", blocks(scene.count), **appearance)
        projection = rasterise.project(space, scene, view, size)
        visible = rasterise.sort_visible(space, projection)
        end, at = self._recorded[-1].end if self._recorded else 0, {}
        for name, words in self._sizes(step).items():
            at[name] = end
            end += words
        results = space.get("results", 4 * max(RESULT_WORDS, end), 4 * (end - at["totals"]))
        length = rasterise.admit(
            space, visible, self._capacity, self.stopped, results, at["totals"]
        )
        lists = rasterise.fill_lists(space, visible, length, self._capacity)
        planes = step.image.surroundings is not None or step.losses is not None
        image = rasterise.blend(space, lists, planes=planes)
        target = self.images.get(step.image)
        d_color, d_planes, loss = self._loss(step, target, image)
        sum_blocks(space, loss.sums, loss.rows, 4, results, at["loss"])
        d_planes = self._with_other_losses(step, image, d_planes)
        slots = rasterise.blend_backward(space, image, d_color, d_planes)
        self._update(step, lists, slots)
        if step.camera_gradients:
            width = layout.CAMERA_PARAMETERS
            rows = self._gradients(step)  # The camera's are the first section.
            sum_blocks(space, rows, scene.count, width, results, at["camera"])
        if appearance is not None:
            space.run("appearance.hide", blocks(scene.count), **appearance)
            space.run("appearance.gradient", blocks(scene.count), **appearance)
            rows = appearance["d_weights"]
            width = self.trained.embedding_size
            sum_blocks(space, rows, scene.count, width, results, at["embedding"])
        self._update_others(step)
        gpu.submit()
        self._recorded.append(_Recorded(step, loss, at, end))

    def _sizes(self, step: ResidentStep) -> dict[str, int]:
        """The words of each part of a step's result, see ``_Recorded``."""
        count = self.scene.count
        tiles = math.prod(layout.tiles_of(step.camera.width, step.camera.height))
        return {
            "totals": rasterise.TOTALS,
            "loss": partial_sums(3 * tiles, 4),
            "camera": step.camera_gradients * partial_sums(count, layout.CAMERA_PARAMETERS),
            "embedding": partial_sums(count, len(step.embedding or ())),
        }

    def _read_results(self) -> None:
        """Wait for the recorded steps. Those that had too many pairs are made again."""
        while self._recorded:
            recorded, self._recorded = self._recorded, []
            end = recorded[-1].end
            results = self.space.get("results", 4 * end)
            words = self.gpu.read(results, np.uint32, end)
            totals = [Totals.of(words[r.at["totals"] :][: rasterise.TOTALS]) for r in recorded]
            for of_step, found in zip(recorded, totals, strict=True):
                dropped = (found.dropped - self._dropped) % (1 << 32)
                self._dropped = found.dropped
                if not found.stopped:
                    self._results.append(self._result(of_step, found, dropped, words))
            self._make_room(totals)
            stopped = [each for each in totals if each.stopped]
            if stopped:
                self.gpu.clear(self.stopped)
                for again in recorded[-len(stopped) :]:
                    self._record(again.step)

    def _make_room(self, totals: Sequence[Totals]) -> None:
        """Give the next steps room by the pairs of the last ones."""
        self._pairs.extend(each.pairs for each in totals)
        self.gpu.counts.pairs = self._pairs[-1]
        most = max(self._pairs)
        if LEAST_ROOM * most <= self._capacity <= max(MIN_CAPACITY, MOST_ROOM * most):
            return
        max(totals, key=lambda each: each.pairs).require_listable()
        self._set_capacity(most, int(ROOM * most))

    def _set_capacity(self, least: int, wanted: int) -> None:
        """Set the room to ``wanted`` pairs, or to fewer, but not less than ``least``, if buffers
        cannot be so large."""
        limit = min(rasterise.MAX_INTERSECTIONS, self.gpu.max_bytes // layout.SLOT_BYTES)
        self._capacity = max(least, min(limit, max(MIN_CAPACITY, wanted)))

    def _result(
        self, recorded: _Recorded, totals: Totals, dropped: int, words: NDArray[np.uint32]
    ) -> StepResult:
        step, numbers, at = recorded.step, words.view(np.float32), recorded.at
        total = add_partial_sums(numbers[at["loss"] : at["camera"]], 4)
        error, ssim, squared = recorded.loss.means(total)
        cameras, embedding = None, None
        if step.camera_gradients:
            rows = numbers[at["camera"] : at["embedding"]]
            cameras = rasterise.camera_gradients(add_partial_sums(rows, layout.CAMERA_PARAMETERS))
        if step.embedding is not None:
            rows = numbers[at["embedding"] : recorded.end]
            embedding = tuple(add_partial_sums(rows, len(step.embedding)).tolist())
        return StepResult(
            loss=(1 - step.ssim_weight) * error + step.ssim_weight * (1 - ssim),
            squared_error=squared,
            num_visible=totals.visible,
            num_dropped=dropped,
            camera=cameras,
            embedding=embedding,
        )

    def _loss(
        self, step: ResidentStep, target: _Image, image: rasterise.Image
    ) -> tuple[Buffer, Buffer | None, LossSums]:
        """The gradients on the colours and, if any, on alpha and depth, and the loss."""
        space, pixels = self.space, step.camera.width * step.camera.height
        size = step.camera.width, step.camera.height
        weights = step.ssim_weight, step.l2_weight, step.image.gain
        if step.image.surroundings is None:
            loss = l1_ssim(space, image.color, target.photograph, size, *weights)
            return loss.gradient, None, loss
        assert image.planes is not None
        composed = space.get("composed image", 12 * pixels)
        around = target.layers, pixels, step.alpha_loss
        compose(
            space, "compose.compose", *around, alpha=image.planes, values=image.color,
            result=composed,
        )  # fmt: skip
        loss = l1_ssim(space, composed, target.photograph, size, *weights)
        d_color = space.get("gradient of the part", 12 * pixels)
        d_planes = space.get("gradients of alpha and depth", 8 * pixels)
        self.gpu.clear(d_planes)
        compose(
            space, "compose.backward", *around, alpha=image.planes, values=loss.gradient,
            result=d_color, d_alpha=d_planes,
        )  # fmt: skip
        return d_color, d_planes, loss

    def _with_other_losses(
        self, step: ResidentStep, image: rasterise.Image, d_planes: Buffer | None
    ) -> Buffer | None:
        """The gradients on alpha and depth (2, H, W) with those of the step's other losses."""
        if step.losses is None:
            return d_planes
        both = np.zeros((2, step.camera.height, step.camera.width), np.float32)
        if d_planes is not None:
            both[:] = self.gpu.read(d_planes, np.float32, both.size).reshape(both.shape)
        found = step.losses(_Planes(self.gpu, image))
        for part, gradient in zip(both, found, strict=True):
            if gradient is not None:
                part += gradient.numpy()
        result = self.space.get("gradients of alpha and depth", both.nbytes)
        self.gpu.write(result, both)
        return result

    def _appearance(self, step: ResidentStep) -> dict[str, Buffer] | None:
        """The buffers of appearance.wgsl, if colours depend on the photograph."""
        if step.embedding is None:
            return None
        space, scene, size = self.space, self.scene, len(step.embedding)
        colors_at, _ = layout.offsets(self._sections(step), scene.count)["colors"]
        sizes = scene.count, size, scene.coefficients, colors_at
        weights = np.array(step.embedding, np.float32)
        return {
            "appearance": space.uniform("sizes of the appearance", "IIII", *sizes),
            "weights": space.write_uniform("embedding", weights.tobytes()),
            "values": self.trained.buffers["appearance"],
            "sh": scene.sh,
            "colours": space.get("colours", 24 * scene.count),
            "gradients": self._gradients(step),
            "d_values": space.get("gradients of the appearance", 12 * size * scene.count),
            "d_weights": space.get("gradients of the embedding", 4 * size * scene.count),
        }

    def _sections(self, step: ResidentStep) -> dict[str, int]:
        """The sections of ``_gradients``."""
        return layout.written_gradients(
            camera=step.camera_gradients,
            colors=step.embedding is not None,
            frames="frames" in step.adam,
        )

    def _gradients(self, step: ResidentStep) -> Buffer:
        """The buffer of the gradients that other kernels than update_gaussians.wgsl read."""
        size = 4 * layout.floats(self._sections(step)) * self.scene.count
        return self.space.get("gradients", size)

    def _update(self, step: ResidentStep, lists: rasterise.Lists, slots: Buffer) -> None:
        """Update all parameters of Gaussians, but means and rotations that move along the world's
        axes, and the statistics."""
        buffers, sections = self.trained.buffers, self._sections(step)
        gradients = {"gradients": self._gradients(step)} if sections else {}
        update_gaussians(
            self.space,
            step.adam,
            self.scene.count,
            (0.5 * step.camera.width, 0.5 * step.camera.height),
            sections,
            stopped=self.stopped,
            radii=lists.projection.radii,
            exp_avg=buffers["first sh"],
            exp_avg_sq=buffers["second sh"],
            last_step=buffers["last"],
            moments=buffers["moments"],
            statistics=buffers["statistics"],
            **rasterise.slots_of_gaussians(lists, slots),
            **gradients,
        )

    def _update_others(self, step: ResidentStep) -> None:
        """Update the parameters that ``_update`` does not."""
        space, count, rates = self.space, self.scene.count, step.adam
        buffers = self.trained.buffers
        if "appearance" in buffers:
            width = 3 * self.trained.embedding_size
            adam_step(
                space, "appearance", rates["appearance"], (count, width), shared=False,
                gradient=space.get("gradients of the appearance", 4 * width * count),
                parameter=buffers["appearance"], moments=buffers["moments of the appearance"],
                stopped=self.stopped,
            )  # fmt: skip
        at = layout.offsets(layout.GEOMETRY, count)
        gradients_at = layout.offsets(self._sections(step), count)
        for name in ("means", "quats"):
            if name in rates:
                adam_step(
                    space, name, rates[name], (count, layout.GEOMETRY[name]), shared=True,
                    at=at[name][0], gradient_at=gradients_at[name][0],
                    moments_at=self.trained.moments_at(f"first {name}"),
                    gradient=self._gradients(step), parameter=buffers["geometry"],
                    moments=buffers["moments"], stopped=self.stopped,
                )  # fmt: skip
