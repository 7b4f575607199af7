"""Losses on the rendered alpha and depth, which a step adds to the loss on colours."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Protocol

from torch import Tensor

from pipeline.render.resident import Planes
from pipeline.training.data.step_view import StepView


class PlaneGradients(NamedTuple):
    """Gradients with respect to the rendered alpha and depth, (H, W) float32; None: zero."""

    alpha: Tensor | None = None
    depth: Tensor | None = None


class PlaneLoss(Protocol):
    """A loss on the rendered alpha or depth."""

    def is_due(self, view: StepView, step: int) -> bool:
        """Whether the loss is computed for this view in the optimiser step of this number."""

    def gradients(self, rendered: Planes, view: StepView) -> PlaneGradients:
        """The gradients of the loss times its weight."""


def summed_gradients(
    losses: Iterable[PlaneLoss], rendered: Planes, view: StepView, step: int
) -> PlaneGradients:
    """The sum of the gradients of the losses that are due."""
    total = PlaneGradients()
    for loss in losses:
        if loss.is_due(view, step):
            found = loss.gradients(rendered, view)
            total = PlaneGradients(add(total.alpha, found.alpha), add(total.depth, found.depth))
    return total


def add(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    """The sum of two gradients; None is zero."""
    if first is None or second is None:
        return first if second is None else second
    return first + second
