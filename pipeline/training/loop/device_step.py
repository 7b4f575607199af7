"""A step in the memory of a device, which has its own copy of the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from pipeline.render import Backend
from pipeline.render.resident import (
    Optimised,
    Planes,
    ResidentImage,
    ResidentStep,
    ResidentTraining,
)
from pipeline.render.resident import StepResult as ResidentResult
from pipeline.training.data.targets import psnr_of
from pipeline.training.loop.setup import TrainingScene
from pipeline.training.loop.state import TrainState
from pipeline.training.loop.step import Step, StepEngine, StepResult
from pipeline.training.losses.alpha import BLOCK_ALPHA_LOSS
from pipeline.training.losses.plane import summed_gradients
from pipeline.training.run import TrainingRun

# The number of steps whose results are read at once.
READ_INTERVAL = 16


@dataclass(frozen=True)
class _Started:
    """A step whose result has not been read, and its number."""

    number: int
    step: Step


class DeviceStep(StepEngine):
    """Renders, differentiates and updates on a device. It makes steps without waiting for their
    results, unless the next step depends on them: refined cameras and embeddings are updated on the
    CPU.

    Before the tensors of ``state`` are read, ``fetch`` makes them current; after they were changed,
    ``invalidate`` makes the next step copy them again.
    """

    def __init__(
        self,
        scene: TrainingScene,
        state: TrainState,
        run: TrainingRun,
        backend: Backend,
        training: ResidentTraining,
    ) -> None:
        super().__init__(scene, state, run, backend)
        self.training = training
        self._loaded = False  # The device has the tensors of the state, or newer ones.
        self._ahead = False  # The device has newer ones.
        self._started: list[_Started] = []

    def step(self, step: Step) -> Sequence[StepResult]:
        state, view, options = self.state, step.view, self.run.options
        if not self._loaded:
            self.training.load(self._optimised())
            self._loaded = True
        self._ahead = True
        embedding = None
        if state.appearance is not None:
            embedding = tuple(state.appearance.embeddings[view.index])

        number = state.step

        def losses(planes: Planes) -> tuple[Tensor | None, Tensor | None]:
            return summed_gradients(self.losses, planes, view, number)

        has_losses = any(loss.is_due(view, number) for loss in self.losses)
        self.training.step(
            ResidentStep(
                camera=view.camera,
                options=step.options,
                image=self._image(step),
                ssim_weight=options.ssim_loss_weight,
                l2_weight=options.experiments.squared_error_loss_weight,
                camera_gradients=state.cameras.enabled,
                embedding=embedding,
                alpha_loss=BLOCK_ALPHA_LOSS,
                losses=losses if has_losses else None,
                adam=state.adam.rates(step.adam),
            )
        )
        self._started.append(_Started(number, step))
        depends = state.cameras.enabled or state.appearance is not None
        return self.results() if depends or len(self._started) == READ_INTERVAL else []

    def results(self) -> Sequence[StepResult]:
        started, self._started = self._started, []
        if not started:
            return []
        return [self._finish(*pair) for pair in zip(started, self.training.results(), strict=True)]

    def _finish(self, started: _Started, result: ResidentResult) -> StepResult:
        """Update the camera and the embedding of a step's photograph."""
        state, step, view = self.state, started.step, started.step.view
        self.require_finite(result.loss, view, started.number)
        if result.camera is not None:
            state.cameras.step(view.index, view.camera, result.camera, step.camera_rate)
        if state.appearance is not None and result.embedding is not None:
            gradient = np.array(result.embedding)
            state.appearance.update(view.index, gradient, self.embedding_rate(step))
        psnr = psnr_of(result.squared_error)
        return StepResult(started.number, result.loss, psnr, result.num_visible, result.num_dropped)

    def fetch(self) -> None:
        assert not self._started
        if self._ahead:
            self.training.store(self._optimised())
            self._ahead = False

    def invalidate(self) -> None:
        self.fetch()
        self._loaded = False

    def _image(self, step: Step) -> ResidentImage:
        view, target = step.view, step.view.target
        fixed = target.alpha is None or self.scene.background != "random"
        transients = self.state.transients
        version = 0 if transients is None else transients.version
        light = self.scene.inputs.light
        return ResidentImage(
            key=(view.index, view.factor, version) if fixed else None,
            target=target.over(view.background),
            mask=target.ignored,
            gain=(1.0, 1.0, 1.0) if light is None else light[view.index].gain,
            surroundings=target.surroundings,
        )

    def _optimised(self) -> Optimised:
        state, adam = self.state, self.state.adam
        assert state.density.statistics is not None
        return Optimised(
            state.gaussians.tensors(), adam.first, adam.second, adam.last, *state.density.statistics
        )
