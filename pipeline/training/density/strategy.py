"""What the trainer asks of a strategy; when it asks, is the schedule's business."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render import Forward, Gradients
from pipeline.splats.gaussians import Gaussians
from pipeline.training.optimisers.adam import Adam


@dataclass
class Changes:
    """Counts of one ``refine``.

    Attributes:
        cloned, split: of which copies and halves were made.
        relocated: useless ones that were laid onto others.
        pruned: removed.
    """

    cloned: int = 0
    split: int = 0
    relocated: int = 0
    pruned: int = 0

    def add(self, other: Changes) -> None:
        self.cloned += other.cloned
        self.split += other.split
        self.relocated += other.relocated
        self.pruned += other.pruned


class Strategy(Protocol):
    """Watches every step and now and then changes the set of Gaussians, Adam's rows with it."""

    def start(self, count: int) -> None:
        """Forget what was observed; ``count`` Gaussians from here on."""

    def regularise(self, gaussians: Gaussians, gradients: Gradients) -> None:
        """Add the gradients of the strategy's own losses, in place."""

    def observe(self, forward: Forward, gradients: Gradients, width: int, height: int) -> None:
        """Take note of one step's view of ``width`` x ``height`` pixels."""

    def explore(self, gaussians: Gaussians, pace: float, rng: np.random.Generator) -> None:
        """After a step: move Gaussians at random, in place; ``pace`` is what the means' rate of the
        step is of the first one's, times the run's boost."""

    def refine(
        self,
        gaussians: Gaussians,
        adam: Adam,
        rng: np.random.Generator,
        *,
        densify: bool,
        prune_huge: bool,
        budget: int,
    ) -> tuple[Gaussians, Changes]:
        """Remove what is of no use and (``densify``) add where more is wanted. What was observed
        is forgotten. Never more than ``budget`` come out, unless more came in."""

    def reset_opacity(self, gaussians: Gaussians, adam: Adam) -> None:
        """Make all Gaussians faint, if that is a habit of the strategy."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What a checkpoint must hold, sharing memory."""

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Become what ``arrays()`` described; other keys are ignored."""


def not_finite(gaussians: Gaussians) -> Tensor:
    """(N,) bool: rows with a value that is no number."""
    bad = torch.zeros(len(gaussians), dtype=torch.bool)
    for tensor in gaussians.tensors().values():
        bad |= ~torch.isfinite(tensor).reshape(len(tensor), tensor[:1].numel()).all(1)
    return bad


def rotations(quats: Tensor) -> Tensor:
    """(N, 3, 3) rotation matrices of quaternions (N, 4) wxyz of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    return torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        1,
    ).view(-1, 3, 3)
