"""The interface of density strategies.

After the backward pass, the backend accumulates ``statistics``; ``before_step`` is called for a
strategy that has none. ``Trainer.control_density`` calls ``after_step`` after the update of the
parameters, if ``is_due``. It decides by the geometry of the Gaussians, and returns what changes;
colours and moments, which can be in the memory of a device, follow (``StepEngine.apply``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render import Forward, Gradients
from pipeline.splats.gaussians import Gaussians, Geometry
from pipeline.splats.morton import morton_order
from pipeline.splats.rows import for_ranges, take_rows
from pipeline.training.density.timeline import Timeline


@dataclass
class Changes:
    """The numbers of Gaussians that density control has changed.

    Attributes:
        cloned, split: The number of Gaussians that were cloned or split.
        relocated: The number of useless Gaussians that were moved onto others.
        pruned: The number of Gaussians that were removed.
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
class DensityStep:
    """What a strategy works on after an optimiser step.

    Attributes:
        geometry: The geometry of the Gaussians, which the strategy may change in place.
        frozen: (N,) bool, the Gaussians that steps do not change.
        bad_colors: Returns (N,) bool, the Gaussians with colours that are not finite.
        rng: The generator of the random numbers of the run.
        steps: The steps of the schedule that the optimiser step covers: one, or any number with a
            time budget.
        noise_rate: The learning rate of the means over its initial value, times the run's factor.
        budget: The upper limit of the number of Gaussians.
        prune: Whether to prune even if the timeline does not say so.
        threads: The number of threads that search and copy Gaussians.
    """

    geometry: Geometry
    frozen: Tensor
    bad_colors: Callable[[], Tensor]
    rng: np.random.Generator
    steps: range
    noise_rate: float = 1.0
    budget: int = 1_000_000_000
    prune: bool = False
    threads: int = 1


@dataclass(frozen=True)
class Refinement:
    """The set of Gaussians that replaces another one: copies of its rows.

    Attributes:
        rows: (M,) int64, the row that each Gaussian is copied from.
        fresh: (M,) bool, the Gaussians without moments.
        changed: (K,) int64, the Gaussians whose geometry is not a copy in all arrays.
        values: Their values, (K, ...), by the names of the arrays that are not copied.
        changes: What was changed.
    """

    rows: Tensor
    fresh: Tensor
    changed: Tensor
    values: Mapping[str, Tensor]
    changes: Changes

    def array(self, name: str, step: DensityStep) -> Tensor:
        """An array of the geometry of the new set."""
        array = take_rows({name: step.geometry.tensors()[name]}, self.rows, step.threads)[name]
        if name in self.values:
            array[self.changed] = self.values[name]
        return array

    def select(self, which: Tensor) -> Refinement:
        """The same set reduced to, or sorted by, int64 indices."""
        places = torch.full_like(self.rows, -1)
        places[which] = torch.arange(len(which))
        changed = places[self.changed]
        kept = changed >= 0
        return replace(
            self,
            rows=self.rows[which],
            fresh=self.fresh[which],
            changed=changed[kept],
            values={name: values[kept] for name, values in self.values.items()},
        )

    def geometry(self, step: DensityStep) -> Geometry:
        """The geometry of the new set."""
        return Geometry(**{name: self.array(name, step) for name in step.geometry.tensors()})


@dataclass(frozen=True)
class Update:
    """The result of a strategy's work after a step.

    Attributes:
        geometry: The geometry of the Gaussians after it.
        refinement: None if the set of Gaussians is the same as before. Otherwise, colours and
            moments are to be copied by its rows.
        opacity_reset: Whether all opacities were reset: their moments are to be forgotten.
    """

    geometry: Geometry
    refinement: Refinement | None
    opacity_reset: bool


class Strategy:
    """Observes every step and, on its timeline, changes the set of Gaussians.

    Subclasses implement ``start`` and ``refine``; the other hooks do nothing unless they are
    overridden.

    Attributes:
        timeline: The steps after which Gaussians are densified and pruned.
    """

    timeline: Timeline

    @property
    def statistics(self) -> tuple[Tensor, Tensor] | None:
        """``gradient_sum`` and ``seen`` of ``Backend.observe_gradients``, if the strategy observes
        nothing else in a step, so that a backend can do it; else None."""
        return None

    def is_due(self, steps: range) -> bool:
        """Return True if ``after_step`` will read or change the Gaussians in these steps. Pruning
        on request is not counted."""
        return self.refines_after(steps) or any(map(self.resets_opacity_after, steps))

    def refines_after(self, steps: range) -> bool:
        return self.densifies_after(steps) or any(map(self.timeline.prunes_after, steps))

    def densifies_after(self, steps: range) -> bool:
        return any(map(self.timeline.densifies_after, steps))

    def resets_opacity_after(self, step: int) -> bool:
        return False

    def before_step(self, gaussians: Gaussians, rendered: Forward, gradients: Gradients) -> None:
        """The hook between the backward pass and the optimiser step: accumulates statistics, and
        adds the gradients of the strategy's own losses, in place."""

    def after_step(self, step: DensityStep) -> Update:
        """The hook after an optimiser step: noise, densification, pruning and opacity resets."""
        geometry, frozen, refinement = step.geometry, step.frozen, None
        if step.prune or self.refines_after(step.steps):
            refinement = self.refine(step)
            # Neighbours in space become neighbours in memory, and the rasterizer skips invisible
            # ones in blocks.
            order = morton_order(refinement.array("means", step), step.threads)
            refinement = refinement.select(order)
            geometry = refinement.geometry(step)
            frozen = frozen[refinement.rows] & ~refinement.fresh
        reset = any(map(self.resets_opacity_after, step.steps))
        if reset:
            self.reset_opacity(geometry, frozen)
        return Update(geometry, refinement, reset)

    def start(self, count: int) -> None:
        """Forget all observations; ``count`` Gaussians are observed from here on."""
        raise NotImplementedError

    def refine(self, step: DensityStep) -> Refinement:
        """Remove useless Gaussians and, if the timeline says so, add new ones. Statistics start
        anew: they are those of the returned set, in any order.

        Returns:
            At most ``step.budget`` Gaussians, or at most as many as before.
        """
        raise NotImplementedError

    def reset_opacity(self, geometry: Geometry, frozen: Tensor) -> None:
        """Lower all opacities but those of ``frozen`` (N,) bool Gaussians, in place."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of a checkpoint, sharing memory."""
        return {}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Restore the state that ``arrays()`` returned; other keys are ignored."""


def useless_values(step: DensityStep) -> Tensor:
    """(N,) bool: Gaussians with a value that is not finite."""
    return not_finite(step.geometry.tensors(), step.threads) | step.bad_colors()


def not_finite(tensors: Mapping[str, Tensor], threads: int = 1) -> Tensor:
    """(N,) bool: rows of tensors (N, ...) with a value that is not finite."""
    count = min(map(len, tensors.values()))
    bad = torch.zeros(count, dtype=torch.bool)

    def find(rows: slice) -> None:
        for tensor in tensors.values():
            part = tensor[rows]
            # A sum is finite only if all values are, and takes less time than a search.
            if not math.isfinite(float(part.sum())):
                bad[rows] |= ~torch.isfinite(part).reshape(len(part), part[:1].numel()).all(1)

    for_ranges(count, threads, find)
    return bad


def highest(score: Tensor, among: Tensor, count: int) -> Tensor:
    """(N,) bool: rows with the ``count`` highest scores ``among`` (N,) bool, the first of ties."""
    if int(among.sum()) <= count:
        return among
    if count <= 0:
        return torch.zeros_like(among)
    # A partition: sorting all scores would take most of the time of density control.
    last = float(np.partition(score[among].numpy(), -count)[-count])
    chosen = among & (score > last)
    ties = torch.nonzero(among & (score == last))[:, 0]
    chosen[ties[: count - int(chosen.sum())]] = True
    return chosen


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
