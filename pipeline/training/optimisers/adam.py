"""Adam for the arrays of Gaussians, whose rows change with density control.

SH coefficients, most of a Gaussian's data, are updated inside the backward pass, and only for
visible Gaussians. Means and rotations are updated along and about each Gaussian's own axes, or as
in 3DGS.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from pipeline.config.settled import TrainOptions
from pipeline.render import (
    AdamRates,
    Backend,
    FrameMoments,
    GaussianAdam,
    Gradients,
    Moments,
    ShAdam,
    make_backend,
)
from pipeline.splats.gaussians import Gaussians, resize_bands

BETA2 = 0.999
# As in 3DGS: gradients of a mean over all pixels are far below the usual 1e-8.
EPSILON = 1e-15
# The second moment of frozen rows. Steps are gradients divided by its root: they round to 0, also
# after it has decayed for a whole schedule. Other second moments are far below FROZEN_ABOVE.
FROZEN, FROZEN_ABOVE = 1e30, 1e10


@dataclass(frozen=True)
class Rates:
    """Learning rates of one step. The unit of ``means`` is each Gaussian's scales if Adam uses
    ``own_frames``, else the world's."""

    means: float
    log_scales: float
    quats: float
    opacity_logits: float
    sh0: float
    shN: float


@dataclass(frozen=True)
class AdamStep:
    """One optimiser step.

    Attributes:
        number: The number of the step, from 1.
        pixels: The number of pixels of the image. The loss is a mean over them and three channels.
    """

    number: int
    rates: Rates
    pixels: int


@dataclass(frozen=True)
class AdamOptions:
    """The options that stay the same during a run.

    Attributes:
        beta1: The decay rate of the first moment.
        own_frames: Update means along, and rotations about, each Gaussian's own axes.
        epsilon: In pixels. Gaussians that change the loss by less than so many pixels do, because
            others hide them or they are small, take smaller steps: their gradients are noise, and
            Adam's steps do not depend on a gradient's size.
    """

    beta1: float
    own_frames: bool
    epsilon: float = 0.0

    @staticmethod
    def of(options: TrainOptions) -> AdamOptions:
        experiments = options.experiments
        own_frames = experiments.means_learning_rate_unit == "gaussian_scale"
        return AdamOptions(experiments.adam_beta1, own_frames, experiments.adam_epsilon)


@lru_cache(maxsize=1)  # A step uses them several times.
def _rates(step: AdamStep, options: AdamOptions) -> dict[str, AdamRates]:
    epsilon = max(options.epsilon / (3 * step.pixels), EPSILON)

    def rates(*lr: float, eps: float = epsilon) -> AdamRates:
        one_or_more = lr if len(lr) > 1 else lr[0]
        return AdamRates(one_or_more, step.number, options.beta1, BETA2, eps)

    lr = step.rates
    found = {name: rates(getattr(lr, name)) for name in ("log_scales", "opacity_logits")}
    found |= {"sh": rates(lr.sh0, lr.shN), "appearance": rates(lr.sh0)}
    if options.own_frames:
        return found | {"frames": rates(lr.means, lr.quats)}
    # The gradient of means that move along the world's axes has another unit.
    return found | {"means": rates(lr.means, eps=EPSILON), "quats": rates(lr.quats)}


class Adam:
    """The moments of each row of ``Gaussians``, and its updates.

    Attributes:
        backend: The backend that performs the updates.
        first, second: The moments by the name of the array, of its shape, float32; those of
            ``sh`` have the shapes and types of ``ShAdam``. With ``own_frames``, those of
            quaternions are (N, 3), about the axes. Without, the second moments of means and
            quaternions are (N, 1), shared by their components. Either way, results do not depend
            on the orientation of the world.
        last: (N,) int32, the last step in which each row had a gradient.
        frozen: (N,) bool, the rows that steps do not change.
    """

    def __init__(self, gaussians: Gaussians, options: AdamOptions, backend: Backend | None = None):
        self.backend = backend or make_backend()
        self.options = options
        tensors = gaussians.tensors()
        self.first = {name: torch.zeros_like(tensor) for name, tensor in tensors.items()}
        self.second = {name: torch.zeros_like(tensor) for name, tensor in tensors.items()}
        count = len(gaussians)
        self.first["sh"] = self.first["sh"].bfloat16()
        self.second["sh"] = torch.zeros(count, gaussians.sh.shape[1], 1)
        if options.own_frames:
            self.first["quats"] = torch.zeros(count, 3)
            self.second["quats"] = torch.zeros(count, 3)
        else:
            self.second["means"] = torch.zeros(count, 1)
            self.second["quats"] = torch.zeros(count, 1)
        self.last = torch.zeros(count, dtype=torch.int32)
        self.frozen = torch.zeros(count, dtype=torch.bool)

    def rates(self, step: AdamStep) -> dict[str, AdamRates]:
        """The rates of each array by its name. With ``own_frames``, ``frames`` has those of means
        and rotations."""
        return _rates(step, self.options)

    def moments(self, name: str) -> Moments:
        """The moments of an array."""
        return Moments(self.first[name], self.second[name])

    def harmonics(self, step: AdamStep) -> ShAdam:
        """The argument of ``Backend.backward`` with which it updates ``sh``."""
        return ShAdam(self.moments("sh"), self.last, self.rates(step)["sh"])

    def of_all(self, step: AdamStep) -> GaussianAdam | None:
        """The argument of ``Backend.update`` with which it updates all arrays but ``appearance``;
        None without ``own_frames``."""
        rates = self.rates(step)
        if "frames" not in rates:
            return None
        return GaussianAdam(
            FrameMoments(self.moments("means"), self.moments("quats")), rates["frames"],
            self.moments("log_scales"), rates["log_scales"],
            self.moments("opacity_logits"), rates["opacity_logits"],
            self.harmonics(step),
        )  # fmt: skip

    def step(
        self, gaussians: Gaussians, gradients: Gradients, step: AdamStep, threads: int
    ) -> None:
        """Update all arrays but ``sh`` and ``appearance``, in place."""
        rates = self.rates(step)
        if "frames" in rates:
            moments = FrameMoments(self.moments("means"), self.moments("quats"))
            self.backend.frame_adam(
                gaussians.means, gaussians.quats, gaussians.log_scales, gradients.means,
                gradients.quats, moments, rates["frames"], threads,
            )  # fmt: skip
        for name, parameter in gaussians.tensors().items():
            if name in rates and name not in ("sh", "appearance"):
                gradient = getattr(gradients, name)
                self.backend.adam_step(
                    parameter, gradient, self.moments(name), rates[name], threads
                )

    def select(self, rows: Tensor, fresh: Tensor, threads: int = 1) -> None:
        """Select rows as ``Gaussians.select(rows)`` does; ``fresh`` (M,) bool rows are set to 0."""
        self.first = self.backend.take_rows(self.first, rows, fresh, threads)
        self.second = self.backend.take_rows(self.second, rows, fresh, threads)
        self.last = self.last[rows]
        self.frozen = self.frozen[rows] & ~fresh

    def freeze(self, rows: Tensor) -> None:
        """Keep ``rows``, (N,) bool, as they are in all steps."""
        self.frozen = self.frozen | rows
        self._reset_frozen(self.first)

    def forget(self, name: str) -> None:
        """Zero the moments of one array."""
        self.first[name].zero_()
        self.second[name].zero_()
        self._reset_frozen([name])

    def restore(
        self, first: Mapping[str, Tensor], second: Mapping[str, Tensor], last: Tensor
    ) -> None:
        """Restore the moments, from which frozen rows are known."""
        self.first, self.second, self.last = dict(first), dict(second), last
        self.frozen = self.second["opacity_logits"] > FROZEN_ABOVE

    def resize_bands(self, degree: int) -> None:
        """Resize the moments as ``Gaussians.with_sh_degree`` does."""
        for moments in (self.first, self.second):
            moments["sh"] = resize_bands(moments["sh"], degree)
        self._reset_frozen(self.first)

    def _reset_frozen(self, names: Iterable[str]) -> None:
        """Give the frozen rows of these arrays the moments that keep them."""
        for name in names:
            self.first[name][self.frozen] = 0.0
            self.second[name][self.frozen] = FROZEN
