"""A step in the memory of a device, which has its own copy of the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipeline.render import Backend
from pipeline.render.resident import (
    Optimised,
    Part,
    Planes,
    ResidentImage,
    ResidentStep,
    ResidentTraining,
)
from pipeline.render.resident import StepResult as ResidentResult
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.rows import new_rows
from pipeline.training.data.targets import psnr_of
from pipeline.training.density import Update
from pipeline.training.loop.setup import TrainingScene
from pipeline.training.loop.state import TrainState
from pipeline.training.loop.step import Step, StepEngine, StepResult
from pipeline.training.losses.alpha import BLOCK_ALPHA_LOSS
from pipeline.training.losses.plane import summed_gradients
from pipeline.training.optimisers.adam import Adam
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

    The device has the tensors of ``state`` from the first step on. Before a part of them is read,
    ``fetch`` makes it current. Only the methods below change them.
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
        self._loaded = False
        self._current = Part.ALL  # The part of the tensors of the state that is current.
        self._started: list[_Started] = []

    def step(self, step: Step) -> Sequence[StepResult]:
        state, view, options = self.state, step.view, self.run.options
        self._load()
        self._current = Part.NOTHING
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

    def fetch(self, part: Part = Part.ALL) -> None:
        assert not self._started
        if self._current < part:
            self.training.store(self._optimised(), part)
            self._current = part

    def lend(self) -> None:
        self.training.lend(self.state.gaussians.parameters())

    def bad_colors(self) -> Tensor:
        return self.training.bad_colors()

    def apply(self, update: Update) -> None:
        assert not self._started and self._current >= Part.GEOMETRY
        state, adam, refinement = self.state, self.state.adam, update.refinement
        if refinement is not None:
            rows, fresh = refinement.rows, refinement.fresh
            one = state.gaussians.first(1)
            self._select(rows, fresh, one, Adam(one, adam.options, adam.backend))
            adam.frozen = adam.frozen[rows] & ~fresh
        state.gaussians = Gaussians(**update.geometry.tensors(), **state.gaussians.colors())
        self.training.load(self._optimised(), Part.GEOMETRY)
        if update.opacity_reset:
            adam.forget("opacity_logits")
            self.training.load_moments(self._optimised(), "opacity_logits")
        self._current = Part.GEOMETRY

    def raise_sh_degree(self, degree: int) -> None:
        self._load()
        adam, one = self.state.adam, self.state.gaussians.first(1).with_sh_degree(degree)
        frozen = Adam(one, adam.options, adam.backend)
        frozen.freeze(torch.ones(1, dtype=torch.bool))
        self._select(torch.arange(len(adam.frozen)), adam.frozen, one, frozen)
        self._current = Part.NOTHING

    def _load(self) -> None:
        if not self._loaded:
            self.training.load(self._optimised())
            self._loaded = True

    def _select(self, rows: Tensor, blank: Tensor, one: Gaussians, adam: Adam) -> None:
        """See ``ResidentTraining.select``. The tensors of the state get the new shapes, but no
        values.

        Args:
            one, adam: One Gaussian and its moments.
        """
        row = _optimised(one, adam, (torch.zeros(1), torch.zeros(1)))
        self.training.select(rows, blank, row)
        state, count = self.state, len(rows)
        state.gaussians = Gaussians(**new_rows(one.tensors(), count))
        state.adam.first = new_rows(adam.first, count)
        state.adam.second = new_rows(adam.second, count)
        state.adam.last = new_rows({"last": adam.last}, count)["last"]

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
        statistics = self.state.density.statistics
        assert statistics is not None
        return _optimised(self.state.gaussians, self.state.adam, statistics)


def _optimised(gaussians: Gaussians, adam: Adam, statistics: tuple[Tensor, Tensor]) -> Optimised:
    return Optimised(gaussians.tensors(), adam.first, adam.second, adam.last, *statistics)
