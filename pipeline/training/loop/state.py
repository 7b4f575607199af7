"""Everything a run must remember to go on after a kill as if nothing had happened."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.splats.gaussians import Gaussians
from pipeline.splats.morton import morton_order
from pipeline.training.cameras.refinement import MovingCameras
from pipeline.training.density import Changes, Strategy
from pipeline.training.optimisers.adam import Adam


@dataclass
class Counters:
    """What happened, summed over the run.

    Attributes:
        changes: of density control.
        opacity_resets: how often.
        max_gaussians: the most there ever were.
        num_dropped: Gaussians the rasterizer left out for numerical reasons, over all steps.
        blind_steps: steps whose view saw no Gaussian.
        unseen: Gaussians left out in the end because no training view saw them.
        floaters: those that hung before one camera and were taken away.
    """

    changes: Changes = field(default_factory=Changes)
    opacity_resets: int = 0
    max_gaussians: int = 0
    num_dropped: int = 0
    blind_steps: int = 0
    unseen: int = 0
    floaters: int = 0


@dataclass
class Window:
    """Sums since the last record of the curve."""

    loss: float = 0.0
    steps: int = 0
    psnr: float = 0.0
    samples: int = 0


@dataclass
class TrainState:
    """The state after ``step`` steps.

    Attributes:
        cameras: what of the views' moves, too.
        clock: where the run is in its schedule: ``step``, unless it has minutes instead of steps.
        order: (V,) int64, this epoch's order of views; ``position`` of them are done.
        curve: records without times; ``curve_seconds`` has the time of each.
        seconds: training time before this process.
    """

    gaussians: Gaussians
    adam: Adam
    density: Strategy
    cameras: MovingCameras
    rng: np.random.Generator
    order: NDArray[np.int64]
    position: int = 0
    step: int = 0
    clock: int = 0
    counters: Counters = field(default_factory=Counters)
    window: Window = field(default_factory=Window)
    curve: list[dict[str, float]] = field(default_factory=list)
    curve_seconds: list[float] = field(default_factory=list)
    seconds: float = 0.0

    def next_view(self) -> int:
        """The next view's index: shuffled epochs, each view once in each."""
        if self.position == len(self.order):
            self.order, self.position = self.rng.permutation(len(self.order)), 0
        self.position += 1
        return int(self.order[self.position - 1])

    def reorder(self) -> None:
        """Lay Gaussians that are near in space next to each other, right after ``refine``, when
        density control has nothing in mind of any. The rasterizer passes over what a view does
        not see sixteen at a time."""
        order = morton_order(self.gaussians.means)
        self.gaussians = self.gaussians.select(order)
        self.adam.select(order, torch.zeros(len(order), dtype=torch.bool))

    def drop_unseen(self, views: int) -> None:
        """Leave out, in the end, what none of the ``views`` photographs looked at in an epoch:
        training made it as it is by chance, and before another camera it would stand as a floater.
        In photographs that were trained on next to nothing changes."""
        # A window this long holds an epoch whole, whatever their orders.
        before = self.step - 2 * views + 1
        seen = self.adam.last > before
        if before > 0 and seen.any():
            self.counters.unseen = int((~seen).sum())
            self.gaussians = self.gaussians.select(torch.nonzero(seen)[:, 0])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays, sharing memory."""
        result: dict[str, NDArray[Any]] = {"order": self.order}
        for name, tensor in self.gaussians.tensors().items():
            result[f"parameter.{name}"] = tensor.numpy()
            result[f"first.{name}"] = self.adam.first[name].numpy()
            result[f"second.{name}"] = self.adam.second[name].numpy()
        result |= self.density.arrays() | self.cameras.arrays()
        return result | {"last": self.adam.last.numpy()}

    def values(self) -> dict[str, Any]:
        """The rest, as JSON; floats survive exactly."""
        return {
            "rng": self.rng.bit_generator.state,
            "position": self.position,
            "clock": self.clock,
            "counters": asdict(self.counters),
            "window": asdict(self.window),
            "curve": self.curve,
            "curve_seconds": self.curve_seconds,
            "seconds": self.seconds,
        }

    def restore(self, step: int, arrays: dict[str, NDArray[Any]], values: dict[str, Any]) -> None:
        """Become what ``arrays()`` and ``values()`` described."""
        self.step, self.order = step, arrays["order"]
        self.gaussians = gaussians_of(arrays)
        self.adam = Adam(self.gaussians, self.adam.beta1, self.adam.own_frames, self.adam.backend)
        for name in self.gaussians.tensors():
            self.adam.first[name] = torch.from_numpy(arrays[f"first.{name}"])
            self.adam.second[name] = torch.from_numpy(arrays[f"second.{name}"])
        self.adam.last = torch.from_numpy(arrays["last"])
        self.density.restore(arrays)
        self.cameras.restore(arrays)
        self.rng.bit_generator.state = values["rng"]
        self.position, self.clock = values["position"], values["clock"]
        counters = dict(values["counters"])
        self.counters = Counters(changes=Changes(**counters.pop("changes")), **counters)
        self.window = Window(**values["window"])
        self.curve, self.curve_seconds = values["curve"], values["curve_seconds"]
        self.seconds = values["seconds"]


def gaussians_of(arrays: dict[str, NDArray[Any]]) -> Gaussians:
    """The Gaussians among a state's arrays."""
    prefix = "parameter."
    found = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
    return Gaussians.from_arrays(found)
