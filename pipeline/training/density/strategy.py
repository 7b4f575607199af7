"""The interface of density strategies: hooks before and after each optimiser step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render import Forward, Gradients
from pipeline.splats.gaussians import Gaussians
from pipeline.training.density.timeline import Timeline
from pipeline.training.optimisers.adam import Adam


@dataclass
class Changes:
    """Counts of one ``refine``.

    Attributes:
        cloned, split: Gaussians that were cloned or split.
        relocated: useless Gaussians that were moved onto others.
        pruned: Gaussians that were removed.
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


@dataclass(frozen=True)
class Update:
    """What a strategy did after a step.

    Attributes:
        gaussians: the Gaussians after it.
        changes: None if the set of Gaussians is the same as before.
        opacity_reset: whether all opacities were reset.
    """

    gaussians: Gaussians
    changes: Changes | None
    opacity_reset: bool


class Strategy:
    """Observes every step and, on its timeline, changes the set of Gaussians and Adam's moments.

    Subclasses implement ``refine``; the other hooks do nothing unless they are overridden.

    Attributes:
        timeline: when Gaussians are densified and pruned.
    """

    timeline: Timeline

    @property
    def statistics(self) -> tuple[Tensor, Tensor] | None:
        """``gradient_sum`` and ``seen`` of ``render.resident.Optimised``, if that is all that the
        hooks of a step do, so that a device can do it; else None."""
        return None

    def is_due(self, steps: range) -> bool:
        """Whether ``after_step`` reads or changes the Gaussians after these steps, if it is not to
        ``prune``. Only of strategies with ``statistics``."""
        rules = (
            self.timeline.densifies_after,
            self.timeline.prunes_after,
            self.resets_opacity_after,
        )
        return any(rule(step) for rule in rules for step in steps)

    @property
    def needs_absolute_gradients(self) -> bool:
        """Whether ``observe`` reads ``Gradients.means2d_abs``."""
        return False

    def before_step(self, gaussians: Gaussians, rendered: Forward, gradients: Gradients) -> None:
        """The hook between the backward pass and the optimiser step."""
        self.observe(rendered, gradients)
        self.regularise(gaussians, gradients)

    def after_step(
        self,
        gaussians: Gaussians,
        adam: Adam,
        rng: np.random.Generator,
        steps: range,
        *,
        rate: float,
        budget: int,
        prune: bool,
    ) -> Update:
        """The hook after an optimiser step: noise, densification, pruning and opacity resets.

        Args:
            steps: steps of the schedule that the optimiser step covers: one, or any number with a
                time budget.
            rate: learning rate of the means over its initial value, times the run's factor.
            budget: upper limit of the number of Gaussians.
            prune: prune even if the timeline does not say so.
        """
        if steps.stop - 1 <= self.timeline.stop:
            self.add_noise(gaussians, rate, rng)
        changes = None
        densify = any(map(self.timeline.densifies_after, steps))
        if densify or prune or any(map(self.timeline.prunes_after, steps)):
            gaussians, changes = self.refine(
                gaussians,
                adam,
                rng,
                densify=densify,
                prune_large=any(map(self.prunes_large_after, steps)),
                budget=budget,
            )
        reset = any(map(self.resets_opacity_after, steps))
        if reset:
            self.reset_opacity(gaussians, adam)
        return Update(gaussians, changes, reset)

    def start(self, count: int) -> None:
        """Forget all observations; ``count`` Gaussians from here on."""

    def observe(self, rendered: Forward, gradients: Gradients) -> None:
        """Accumulate statistics of one step."""

    def regularise(self, gaussians: Gaussians, gradients: Gradients) -> None:
        """Add the gradients of the strategy's own losses, in place."""

    def add_noise(self, gaussians: Gaussians, rate: float, rng: np.random.Generator) -> None:
        """Move Gaussians at random, in place; ``rate`` as in ``after_step``."""

    def refine(
        self,
        gaussians: Gaussians,
        adam: Adam,
        rng: np.random.Generator,
        *,
        densify: bool,
        prune_large: bool,
        budget: int,
    ) -> tuple[Gaussians, Changes]:
        """Remove useless Gaussians and (``densify``) add new ones. Statistics start anew.

        The result has at most ``budget`` Gaussians, or at most as many as before.
        """
        raise NotImplementedError

    def resets_opacity_after(self, step: int) -> bool:
        return False

    def prunes_large_after(self, step: int) -> bool:
        return False

    def reset_opacity(self, gaussians: Gaussians, adam: Adam) -> None:
        """Lower all opacities, in place."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of a checkpoint, sharing memory."""
        return {}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Restore the state that ``arrays()`` returned; other keys are ignored."""


def not_finite(gaussians: Gaussians) -> Tensor:
    """(N,) bool: rows with a value that is not finite."""
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
