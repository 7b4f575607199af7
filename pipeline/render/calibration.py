"""The time of a training step on each device of this machine, for ``train.device: auto``."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch

from pipeline.render.backend import Backend
from pipeline.render.resident import (
    GaussianAdam,
    Optimised,
    ResidentImage,
    ResidentStep,
    ResidentTraining,
)
from pipeline.render.types import (
    AlphaChangeLoss,
    DenseAdam,
    FrameAdam,
    RasterCamera,
    RasterOptions,
    ShAdam,
)

# A typical scene of the preset `balanced` in the middle of its training.
GAUSSIANS, WIDTH, HEIGHT = 100_000, 640, 480
STEPS = 5
_RATES = dict.fromkeys(("means", "log_scales", "quats", "opacity_logits", "sh0", "shN"), 1e-6)
_SSIM_WEIGHT = 0.2


def step_seconds(backend: Backend, gaussians: int = GAUSSIANS, steps: int = STEPS) -> float:
    """Median time of a training step of a made scene, in seconds."""
    state, camera, target = _scene(gaussians)
    training = backend.resident()
    step = (
        _by_operators(backend, state, camera, target)
        if training is None
        else _resident(training, state, camera, target)
    )
    step()  # Compiles kernels and allocates memory.
    times = []
    for _ in range(steps):
        start = time.perf_counter()
        step()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def _scene(count: int) -> tuple[Optimised, RasterCamera, torch.Tensor]:
    """Gaussians of a few pixels in a camera's view, and noise as the photograph."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    depth = 2 + 4 * uniform(count)
    across = (uniform(count, 2) - 0.5) * torch.tensor([WIDTH, HEIGHT]) / WIDTH
    parameters = {
        "means": torch.cat([across * depth[:, None], depth[:, None]], 1),
        "log_scales": torch.log(2.5 / WIDTH * depth[:, None] * (0.5 + uniform(count, 3))),
        "quats": uniform(count, 4) - 0.5,
        "opacity_logits": 4 * uniform(count) - 2,
        "sh": 0.3 * (uniform(count, 16, 3) - 0.5),
    }
    first = {name: torch.zeros_like(tensor) for name, tensor in parameters.items()}
    first["quats"] = torch.zeros(count, 3)
    second = {name: torch.zeros_like(tensor) for name, tensor in first.items()}
    last = torch.zeros(count, dtype=torch.int32)
    state = Optimised(parameters, first, second, last, torch.zeros(count), torch.zeros(count))
    centre = WIDTH / 2, HEIGHT / 2
    camera = RasterCamera(WIDTH, HEIGHT, WIDTH, WIDTH, *centre, torch.eye(4, dtype=torch.float64))
    target = (255 * uniform(HEIGHT, WIDTH, 3)).to(torch.uint8)
    return state, camera, target


def _resident(
    training: ResidentTraining, state: Optimised, camera: RasterCamera, target: torch.Tensor
) -> Callable[[], object]:
    training.load(state)
    adam = GaussianAdam(_RATES, 1, True, 0.9, 0.999, 1e-15, 1e-15)
    image = ResidentImage((0, 1), target, None, (1.0, 1.0, 1.0), None)
    no_loss = AlphaChangeLoss(0.0, 0.0, 0.0)
    step = ResidentStep(
        camera, RasterOptions(), image, _SSIM_WEIGHT, 0.0, True, False, no_loss, None, adam
    )
    return lambda: training.step(step)


def _by_operators(
    backend: Backend, state: Optimised, camera: RasterCamera, target: torch.Tensor
) -> Callable[[], object]:
    p, first, second = state.parameters, state.first, state.second
    means, log_scales, quats = p["means"], p["log_scales"], p["quats"]
    inputs = means, log_scales, quats, p["opacity_logits"], p["sh"]
    moments = first["means"], second["means"], first["quats"], second["quats"]

    def step() -> None:
        drawn = backend.forward(*inputs, camera, RasterOptions())
        loss = backend.l1_ssim(drawn.color, target, _SSIM_WEIGHT)
        sh = ShAdam(first["sh"], second["sh"], state.last, 1e-6, 1e-6, 1)
        gradients = backend.backward(drawn, loss.grad, sh_adam=sh)
        frame = FrameAdam(*moments, 1e-6, 1e-6, 1)
        backend.frame_adam(
            *inputs[:1], inputs[2], inputs[1], gradients.means, gradients.quats, frame
        )
        for name in ("log_scales", "opacity_logits"):
            adam = DenseAdam(first[name], second[name], 1e-6, 1)
            backend.adam_step(p[name], getattr(gradients, name), adam)

    return step
