"""Optimisation of merged Gaussians, so that they look like those that they replace.

The renders of all Gaussians are the targets, not photographs: a scene's file and its cameras are
enough, and light, masks and embeddings do not matter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pipeline.config.settled import TrainOptions
from pipeline.render import BACKGROUNDS, Backend, RasterOptions, make_backend
from pipeline.render.views import raster_camera
from pipeline.runtime.progress import track
from pipeline.runtime.torch_threads import single_torch_thread
from pipeline.scene.views import View
from pipeline.splats.arrays import GaussianArrays
from pipeline.splats.gaussians import Gaussians
from pipeline.training.data.image_store import DiskStore, Planes
from pipeline.training.loop.schedule import Schedule, warm_up
from pipeline.training.optimisers.adam import Adam, AdamOptions, AdamStep

#: Number of steps.
STEPS = 1000
#: The steps are the last of a schedule: merged Gaussians are close to where they belong.
SCHEDULE_SHARE = 0.5


def refined(
    merged: GaussianArrays,
    everything: GaussianArrays,
    views: Sequence[View],
    options: RasterOptions,
    steps: int = STEPS,
) -> GaussianArrays:
    """Optimise Gaussians for renders like those of ``everything``, with the loss and the learning
    rates of training and without density control.

    Args:
        merged: The initial Gaussians, which are not changed.
        everything: The Gaussians whose renders are the targets, of the same SH degree.
        views: The views to render.
        options: How they are rendered. The number of threads does not affect results.
    """
    copy = {name: value.copy() for name, value in merged.arrays().items()}
    gaussians = Gaussians.sharing(replace(merged, **copy))
    train = TrainOptions(steps=round(steps / (1 - SCHEDULE_SHARE)))
    schedule = Schedule.of(train)
    span = range(schedule.steps - steps, schedule.steps)
    background = options.background or BACKGROUNDS["black"]
    options = replace(options, background=background, sh_degree=gaussians.sh_degree)
    with single_torch_thread():
        backend = make_backend()
        targets = _Targets(Gaussians.sharing(everything), views, options, backend, steps)
        adam = Adam(gaussians, AdamOptions.of(train), backend)
        rng, order = np.random.default_rng(0), list[int]()
        for number in track(range(1, steps + 1), "refining", steps, unit="steps"):
            order = order or rng.permutation(len(views)).tolist()
            index = order.pop()
            camera = raster_camera(views[index])
            rates = schedule.learning_rates(
                span[number - 1] + 1, schedule.steps, 1.0, warm_up(span, number)
            )
            step = AdamStep(number, rates, camera.width * camera.height)
            rendered = backend.forward(*gaussians.parameters(), camera, options)
            loss = backend.l1_ssim(
                rendered.color,
                targets[index],
                train.ssim_loss_weight,
                threads=options.threads,
            )
            gradients = backend.backward(rendered, loss.grad, sh_adam=adam.harmonics(step))
            adam.step(gaussians, gradients, step, options.threads)
    return gaussians.as_arrays()


class _Targets:
    """Renders of all Gaussians, (H, W, 3) uint8, stored if they are used again."""

    def __init__(
        self,
        everything: Gaussians,
        views: Sequence[View],
        options: RasterOptions,
        backend: Backend,
        steps: int,
    ) -> None:
        self._arguments = everything, views, options, backend
        self._store = DiskStore() if steps > len(views) else None
        self._found: dict[int, Callable[[], Planes]] = {}

    def __getitem__(self, index: int) -> Tensor:
        if index in self._found:
            (pixels,) = self._found[index]()
            assert pixels is not None
            return pixels
        everything, views, options, backend = self._arguments
        camera = raster_camera(views[index])
        color = backend.forward(*everything.parameters(), camera, options).color
        pixels = (color.clamp(0, 1) * 255).round().to(torch.uint8)
        if self._store is not None:
            self._found[index] = self._store.add((pixels,))
        return pixels
