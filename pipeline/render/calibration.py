"""The time of a training step on a device, for ``train.device: auto`` and benchmarks."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pipeline.render.backend import Backend
from pipeline.render.checks import Parameters
from pipeline.render.resident import Optimised, ResidentImage, ResidentStep, ResidentTraining
from pipeline.render.types import (
    AdamRates,
    AlphaChangeLoss,
    FrameMoments,
    Moments,
    RasterCamera,
    RasterOptions,
    ShAdam,
)

# A typical scene of the preset `balanced` in the middle of its training.
GAUSSIANS, WIDTH, HEIGHT = 100_000, 640, 480
STEPS = 5
SSIM_WEIGHT = 0.2
NAMES = ("means", "log_scales", "quats", "opacity_logits", "sh")
DENSE = ("log_scales", "opacity_logits")
# Learning rates of zero: the step can be repeated.
RATE, TWO_RATES = AdamRates(0.0, 1), AdamRates((0.0, 0.0), 1)


@dataclass(frozen=True)
class StepScene:
    """The inputs of a step: Gaussians, a camera and its photograph (H, W, 3) uint8."""

    gaussians: Parameters
    camera: RasterCamera
    target: Tensor


class Steps(Protocol):
    """A function that makes training steps."""

    def __call__(self, steps: int = 1) -> None:
        """Make ``steps`` steps, then wait for them."""


def step_seconds(backend: Backend, gaussians: int = GAUSSIANS, steps: int = STEPS) -> float:
    """Median time of a training step of a synthetic scene, in seconds."""
    step = training_step(backend, made_scene(gaussians))
    step()  # Compiles kernels and allocates memory.
    times = []
    for _ in range(steps):
        start = time.perf_counter()
        step()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def made_scene(count: int) -> StepScene:
    """Gaussians of a few pixels in a camera's view, and noise as the photograph."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    depth = 2 + 4 * uniform(count)
    across = (uniform(count, 2) - 0.5) * torch.tensor([WIDTH, HEIGHT]) / WIDTH
    gaussians = (
        torch.cat([across * depth[:, None], depth[:, None]], 1),
        torch.log(2.5 / WIDTH * depth[:, None] * (0.5 + uniform(count, 3))),
        uniform(count, 4) - 0.5,
        4 * uniform(count) - 2,
        0.3 * (uniform(count, 16, 3) - 0.5),
    )
    centre = WIDTH / 2, HEIGHT / 2
    camera = RasterCamera(WIDTH, HEIGHT, WIDTH, WIDTH, *centre, torch.eye(4, dtype=torch.float64))
    return StepScene(gaussians, camera, (255 * uniform(HEIGHT, WIDTH, 3)).to(torch.uint8))


def training_step(backend: Backend, scene: StepScene) -> Steps:
    """Return a function that makes steps and waits for them, which can be repeated."""
    training = backend.resident()
    if training is None:
        return _by_operators(backend, scene, _optimised(scene))
    return _resident(training, scene, _optimised(scene))


def _optimised(scene: StepScene) -> Optimised:
    count = len(scene.gaussians[0])
    parameters = dict(zip(NAMES, scene.gaussians, strict=True))
    first = {name: torch.zeros_like(tensor) for name, tensor in parameters.items()}
    first["quats"] = torch.zeros(count, 3)
    second = {name: torch.zeros_like(tensor) for name, tensor in first.items()}
    first["sh"], second["sh"] = first["sh"].bfloat16(), second["sh"][..., :1].contiguous()
    last = torch.zeros(count, dtype=torch.int32)
    return Optimised(parameters, first, second, last, torch.zeros(count), torch.zeros(count))


def _resident(training: ResidentTraining, scene: StepScene, state: Optimised) -> Steps:
    training.load(state)
    step = ResidentStep(
        camera=scene.camera,
        options=RasterOptions(),
        image=ResidentImage((0, 1), scene.target, None, (1.0, 1.0, 1.0), None),
        ssim_weight=SSIM_WEIGHT,
        l2_weight=0.0,
        camera_gradients=False,
        embedding=None,
        alpha_loss=AlphaChangeLoss(0.0, 0.0, 0.0),
        losses=None,
        adam={"frames": TWO_RATES, "sh": TWO_RATES, **dict.fromkeys(DENSE, RATE)},
    )

    def make(steps: int = 1) -> None:
        for _ in range(steps):
            training.step(step)
        training.results()

    return make


def _by_operators(backend: Backend, scene: StepScene, state: Optimised) -> Steps:
    means, log_scales, quats, _, _ = scene.gaussians
    moments = {name: Moments(state.first[name], state.second[name]) for name in NAMES}
    harmonics = ShAdam(moments["sh"], state.last, TWO_RATES)
    frames = FrameMoments(moments["means"], moments["quats"])

    def step() -> None:
        drawn = backend.forward(*scene.gaussians, scene.camera, RasterOptions())
        loss = backend.l1_ssim(drawn.color, scene.target, SSIM_WEIGHT)
        g = backend.backward(drawn, loss.grad, sh_adam=harmonics)
        backend.frame_adam(means, quats, log_scales, g.means, g.quats, frames, TWO_RATES)
        for name in DENSE:
            backend.adam_step(state.parameters[name], getattr(g, name), moments[name], RATE)

    def make(steps: int = 1) -> None:
        for _ in range(steps):
            step()

    return make
