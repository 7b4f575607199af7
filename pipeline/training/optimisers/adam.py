"""Adam for the arrays of Gaussians, whose rows change with density control.

SH coefficients, most of a Gaussian's data, are updated inside the backward pass, and only for
visible Gaussians. Means and rotations are updated along and about each Gaussian's own axes, or as
in 3DGS.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from pipeline.config.settled import TrainOptions
from pipeline.render import Backend, DenseAdam, FrameAdam, Gradients, ShAdam, make_backend
from pipeline.render.resident import GaussianAdam
from pipeline.splats.gaussians import Gaussians, resize_bands

BETA2 = 0.999
# As in 3DGS: gradients of a mean over all pixels are far below the usual 1e-8.
EPSILON = 1e-15


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
        number: counts from 1.
        pixels: number of pixels of the image. The loss is a mean over them and three channels.
    """

    number: int
    rates: Rates
    pixels: int


@dataclass(frozen=True)
class AdamOptions:
    """What does not change during a run.

    Attributes:
        beta1: decay rate of the first moment.
        own_frames: update means along, and rotations about, each Gaussian's own axes.
        epsilon: pixels. Gaussians that change the loss by less than so many pixels do, because
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


class Adam:
    """First and second moments of each row of ``Gaussians``.

    Attributes:
        options: of the run.
        backend: performs the updates.
        first, second: moments by the name of the array, of its shape, float32. With ``own_frames``,
            those of quaternions are (N, 3), about the axes. Without, the second moments of means
            and quaternions are (N, 1), shared by their components. Either way, results do not
            depend on the orientation of the world.
        last: (N,) int32, the last step in which each row had a gradient.
    """

    def __init__(self, gaussians: Gaussians, options: AdamOptions, backend: Backend | None = None):
        self.backend = backend or make_backend()
        self.options = options
        tensors = gaussians.tensors()
        self.first = {name: torch.zeros_like(tensor) for name, tensor in tensors.items()}
        self.second = {name: torch.zeros_like(tensor) for name, tensor in tensors.items()}
        count = len(gaussians)
        if options.own_frames:
            self.first["quats"] = torch.zeros(count, 3)
            self.second["quats"] = torch.zeros(count, 3)
        else:
            self.second["means"] = torch.zeros(count, 1)
            self.second["quats"] = torch.zeros(count, 1)
        self.last = torch.zeros(count, dtype=torch.int32)

    def harmonics(self, step: AdamStep) -> ShAdam:
        """Arguments of ``backward``, which updates ``sh``."""
        return ShAdam(
            self.first["sh"], self.second["sh"], self.last, step.rates.sh0, step.rates.shN,
            step.number, self.options.beta1, BETA2, self.epsilon(step),
        )  # fmt: skip

    def appearance(self, step: AdamStep) -> DenseAdam:
        """Adam of ``Gaussians.appearance``, at the learning rate of SH coefficient 0."""
        return DenseAdam(
            self.first["appearance"], self.second["appearance"], step.rates.sh0, step.number,
            self.options.beta1, BETA2, self.epsilon(step),
        )  # fmt: skip

    def step(
        self, gaussians: Gaussians, gradients: Gradients, step: AdamStep, threads: int
    ) -> None:
        """Update all arrays but ``sh`` and ``appearance``, in place."""
        updated = {"sh", "appearance"}
        if self.options.own_frames:
            updated |= {"means", "quats"}
            self.backend.frame_adam(
                gaussians.means, gaussians.quats, gaussians.log_scales, gradients.means,
                gradients.quats, self.frames(step), threads,
            )  # fmt: skip
        for name, parameter in gaussians.tensors().items():
            if name in updated:
                continue
            # The gradient of means that move along the world's axes has another unit.
            epsilon = EPSILON if name == "means" else self.epsilon(step)
            adam = DenseAdam(
                self.first[name], self.second[name], getattr(step.rates, name), step.number,
                self.options.beta1, BETA2, epsilon,
            )  # fmt: skip
            self.backend.adam_step(parameter, getattr(gradients, name), adam, threads)

    def frames(self, step: AdamStep) -> FrameAdam:
        return FrameAdam(
            self.first["means"], self.second["means"], self.first["quats"], self.second["quats"],
            step.rates.means, step.rates.quats, step.number, self.options.beta1, BETA2,
            self.epsilon(step),
        )  # fmt: skip

    def resident(self, step: AdamStep) -> GaussianAdam:
        """The same updates, of all arrays, by a device."""
        epsilon = self.epsilon(step)
        return GaussianAdam(
            asdict(step.rates), step.number, self.options.own_frames, self.options.beta1, BETA2,
            epsilon, EPSILON,
        )  # fmt: skip

    def epsilon(self, step: AdamStep) -> float:
        return max(self.options.epsilon / (3 * step.pixels), EPSILON)

    def select(self, rows: Tensor, fresh: Tensor) -> None:
        """Select rows as ``Gaussians.select(rows)`` does; ``fresh`` (M,) bool rows are set to 0."""
        for moments in (self.first, self.second):
            for name, tensor in moments.items():
                moments[name] = tensor[rows].contiguous()
                moments[name][fresh] = 0.0
        self.last = self.last[rows]

    def forget(self, name: str) -> None:
        """Zero the moments of one array."""
        self.first[name].zero_()
        self.second[name].zero_()

    def resize_bands(self, degree: int) -> None:
        """Resize the moments as ``Gaussians.with_sh_degree`` does."""
        for moments in (self.first, self.second):
            moments["sh"] = resize_bands(moments["sh"], degree)
