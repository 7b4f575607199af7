"""The state of training, which checkpoints contain: resumed runs give the same bits."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.splats.gaussians import Gaussians
from pipeline.splats.skybox import Sky
from pipeline.training.appearance.embedding import AppearanceEmbeddings
from pipeline.training.cameras.refinement import CameraRefinement
from pipeline.training.checkpoints.form import check_arrays, check_position
from pipeline.training.density import Changes, Strategy, Update
from pipeline.training.few_views import EarlyFit
from pipeline.training.loop.curve import CurveRecord
from pipeline.training.optimisers.adam import Adam
from pipeline.training.transients.search import Transients

CURVE_RECORDS = 100  # The number of records of the curve in a run.


@dataclass
class Counters:
    """Totals of the run.

    Attributes:
        changes: The changes by density control.
        opacity_resets: The number of opacity resets.
        max_gaussians: The largest number of Gaussians.
        num_dropped: The number of Gaussians that the rasterizer left out for numerical reasons,
            over all steps.
        blind_steps: The number of steps whose view saw no Gaussian.
        unseen: The number of Gaussians removed at the end because no training view saw them.
        floaters: The number of Gaussians removed because they were close to a single camera.
        ghosts: The number of Gaussians removed because they explained transients.
    """

    changes: Changes = field(default_factory=Changes)
    opacity_resets: int = 0
    max_gaussians: int = 0
    num_dropped: int = 0
    blind_steps: int = 0
    unseen: int = 0
    floaters: int = 0
    ghosts: int = 0


@dataclass
class CurveWindow:
    """Sums since the last record of the curve."""

    loss: float = 0.0
    steps: int = 0
    psnr: float = 0.0


@dataclass
class TrainState:
    """The state after ``step`` steps.

    Attributes:
        clock: The position in the schedule: ``step``, or less or more with a time budget.
        order: (V,) int64, the order of the views in this epoch, of which ``position`` are done.
        appearance: The embeddings of the views; None if appearance is not modelled.
        early_fit: The fit while one view was held back; None until it is measured.
        transients: What only single views show; None if it is not searched for.
        curve: The records without times; ``curve_seconds`` has the time of each.
        seconds: The training time so far, in all processes.
    """

    gaussians: Gaussians
    adam: Adam
    density: Strategy
    cameras: CameraRefinement
    rng: np.random.Generator
    order: NDArray[np.int64]
    appearance: AppearanceEmbeddings | None = None
    early_fit: EarlyFit | None = None
    transients: Transients | None = None
    position: int = 0
    step: int = 0
    clock: int = 0
    counters: Counters = field(default_factory=Counters)
    window: CurveWindow = field(default_factory=CurveWindow)
    curve: list[CurveRecord] = field(default_factory=list)
    curve_seconds: list[float] = field(default_factory=list)
    seconds: float = 0.0

    def next_view(self) -> int:
        """Index of the next view: each view once in each shuffled epoch."""
        if self.position == len(self.order):
            self.order, self.position = self.rng.permutation(len(self.order)), 0
        self.position += 1
        return int(self.order[self.position - 1])

    def apply(self, update: Update, threads: int) -> None:
        """Change the Gaussians and their moments as density control has decided."""
        colors, refinement = self.gaussians.colors(), update.refinement
        if refinement is not None:
            self.adam.select(refinement.rows, refinement.fresh, threads)
            colors = self.adam.backend.take_rows(colors, refinement.rows, threads=threads)
        self.gaussians = Gaussians(**update.geometry.tensors(), **colors)
        if update.opacity_reset:
            self.adam.forget("opacity_logits")

    def count(self, update: Update) -> None:
        """Add what density control has decided to the counters."""
        self.counters.opacity_resets += update.opacity_reset
        if update.refinement is not None:
            self.counters.changes.add(update.refinement.changes)

    def add_to_window(self, loss: float, psnr: float) -> None:
        """Add a step to the sums of the curve's next record."""
        self.window.loss += loss
        self.window.psnr += psnr
        self.window.steps += 1

    def drop_unseen(self, views: int, sky: Sky | None) -> None:
        """At the end, remove Gaussians without a gradient in a whole epoch of ``views`` views: no
        training view constrains them, and other cameras can see them as floaters. The sky stays,
        which fills what no view shows."""
        # So many steps contain a whole epoch, in any order of the views.
        before = self.step - 2 * views + 1
        seen = self.adam.last > before
        if before > 0 and seen.any():
            kept = seen | self.adam.frozen
            if sky is not None:
                kept |= torch.from_numpy(sky.contains(self.gaussians.means.numpy()))
            self.counters.unseen = int((~kept).sum())
            self.gaussians = self.gaussians.select(torch.nonzero(kept)[:, 0])

    def record(self) -> None:
        """Add a record to the curve and begin a new window."""
        window = self.window
        self.curve.append(
            CurveRecord(
                step=self.step,
                loss=window.loss / max(1, window.steps),
                psnr=window.psnr / max(1, window.steps),
                num_gaussians=len(self.gaussians),
            )
        )
        self.curve_seconds.append(self.seconds)
        self.window = CurveWindow()

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of a checkpoint, sharing memory."""
        result: dict[str, NDArray[Any]] = {"order": self.order}
        for name, tensor in self.gaussians.tensors().items():
            result[f"parameter.{name}"] = tensor.numpy()
            first = self.adam.first[name]
            # numpy has no bfloat16.
            bits = first.view(torch.uint16) if first.dtype == torch.bfloat16 else first
            result[f"first.{name}"] = bits.numpy()
            result[f"second.{name}"] = self.adam.second[name].numpy()
        result |= self.density.arrays() | self.cameras.arrays()
        if self.appearance is not None:
            result |= self.appearance.arrays()
        if self.transients is not None:
            result |= self.transients.arrays()
        return result | {"last": self.adam.last.numpy()}

    def values(self) -> dict[str, Any]:
        """The rest of a checkpoint, as JSON, which keeps floats exactly."""
        return {
            "rng": self.rng.bit_generator.state,
            "position": self.position,
            "clock": self.clock,
            "early_fit": self.early_fit and asdict(self.early_fit),
            "counters": asdict(self.counters),
            "window": asdict(self.window),
            "curve": [record.model_dump() for record in self.curve],
            "curve_seconds": self.curve_seconds,
            "seconds": self.seconds,
        }

    def restore(self, step: int, arrays: dict[str, NDArray[Any]], values: dict[str, Any]) -> None:
        """Restore the state that ``arrays()`` and ``values()`` returned.

        Raises:
            ValueError: The values are not those of such a run. The state is unchanged.
        """
        check_arrays(arrays, self.arrays())
        rng = np.random.default_rng()
        # The values are JSON; what they lack or hold instead raises exceptions of many types.
        try:
            check_position(values, len(self.order))
            rng.bit_generator.state = values["rng"]
            fit = values["early_fit"]
            early_fit = fit and EarlyFit(float(fit["held_back"]), float(fit["others"]))
            counters = dict(values["counters"])
            restored = Counters(changes=Changes(**counters.pop("changes")), **counters)
            window = CurveWindow(**values["window"])
            curve = [CurveRecord.model_validate(record) for record in values["curve"]]
            curve_seconds = [float(seconds) for seconds in values["curve_seconds"]]
            seconds = float(values["seconds"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{type(error).__name__} in its values") from None
        self.step, self.order = step, arrays["order"]
        self.gaussians = gaussians_of(arrays)
        self.adam = Adam(self.gaussians, self.adam.options, self.adam.backend)
        names = self.gaussians.tensors()
        first = {
            name: torch.from_numpy(arrays[f"first.{name}"]).view(self.adam.first[name].dtype)
            for name in names
        }
        second = {name: torch.from_numpy(arrays[f"second.{name}"]) for name in names}
        self.adam.restore(first, second, torch.from_numpy(arrays["last"]))
        self.density.restore(arrays)
        self.cameras.restore(arrays)
        if self.appearance is not None:
            self.appearance.restore(arrays)
        if self.transients is not None:
            self.transients.restore(arrays)
        self.rng.bit_generator.state = values["rng"]
        self.position, self.clock = values["position"], values["clock"]
        self.early_fit = early_fit
        self.counters, self.window, self.curve = restored, window, curve
        self.curve_seconds, self.seconds = curve_seconds, seconds


def gaussians_of(arrays: dict[str, NDArray[Any]]) -> Gaussians:
    """The Gaussians in the arrays of a checkpoint."""
    prefix = "parameter."
    found = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
    return Gaussians.from_arrays(found)
