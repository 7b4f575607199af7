"""One step of the optimisation, and the interface of what computes it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pipeline.render import Backend, RasterOptions
from pipeline.runtime.errors import UserError
from pipeline.training.data.step_view import StepView
from pipeline.training.loop.setup import TrainingScene
from pipeline.training.loop.state import TrainState
from pipeline.training.losses.alpha import AlphaLoss
from pipeline.training.losses.depth import DepthLoss
from pipeline.training.losses.plane import PlaneLoss
from pipeline.training.optimisers.adam import AdamStep
from pipeline.training.run import TrainingRun


@dataclass(frozen=True)
class Step:
    """The inputs of an optimiser step.

    Attributes:
        camera_rate: The learning rate of the parameters of cameras and photographs that a share of
            the steps uses (``Schedule.camera_rate``), as a function of that share.
        dropped_share: The share of the Gaussians that is not drawn (``training.few_views``).
    """

    view: StepView
    options: RasterOptions
    adam: AdamStep
    camera_rate: Callable[[float], float]
    dropped_share: float = 0.0


@dataclass(frozen=True)
class StepResult:
    """The figures of step ``number``; ``psnr`` in dB."""

    number: int
    loss: float
    psnr: float
    num_visible: int
    num_dropped: int


class StepEngine(ABC):
    """Renders a view, compares it with its photograph, and updates all parameters."""

    def __init__(
        self, scene: TrainingScene, state: TrainState, run: TrainingRun, backend: Backend
    ) -> None:
        self.scene, self.state, self.run, self.backend = scene, state, run, backend
        self.losses = plane_losses(scene, run)

    @abstractmethod
    def step(self, step: Step) -> Sequence[StepResult]:
        """Change ``state`` by one step.

        Returns:
            The results that are known, in order: that of this step, or those of steps before.

        Raises:
            UserError: The loss of one of these steps is not finite.
        """

    @abstractmethod
    def results(self) -> Sequence[StepResult]:
        """Complete all steps; returns the results that ``step`` has not returned, in order.

        Raises:
            UserError: As ``step``.
        """

    @abstractmethod
    def fetch(self) -> None:
        """Make the tensors of ``state`` current, before they are read. To be called after
        ``results``."""

    @abstractmethod
    def invalidate(self) -> None:
        """Make the tensors of ``state`` current, and read them again before the next step. To be
        called after ``results`` and before they are changed."""

    def require_finite(self, loss: float, view: StepView, number: int) -> None:
        """Raise a UserError if the loss of step ``number`` is not finite."""
        if not math.isfinite(loss):
            raise UserError(
                f"the loss is not finite at step {number}, view {view.full.name}",
                fix="lower experiments.train.learning_rate_factor, or check the poses and points",
            )

    def embedding_rate(self, step: Step) -> float:
        """The learning rate of an appearance embedding, which one view uses."""
        return step.camera_rate(1 / len(self.scene.views))


def plane_losses(scene: TrainingScene, run: TrainingRun) -> Sequence[PlaneLoss]:
    """The losses besides that on colours."""
    options, depths = run.options, scene.inputs.depths
    losses: list[PlaneLoss] = [
        AlphaLoss(
            # Before a skybox, masks hide what is in the way, and leave no empty space.
            options.experiments.mask_loss_weight if scene.sky is None else 0.0,
            options.experiments.alpha_loss_weight,
            options.experiments.squared_error_loss_weight,
        )
    ]
    if depths is not None and options.depth_loss_weight:
        losses.append(DepthLoss(depths, options.depth_loss_weight))
    return losses
