"""Adam over the five arrays of Gaussians, whose rows come and go.

The harmonics, four fifths of a Gaussian, are moved inside the backward pass and in view alone.
Means and rotations move along and about each Gaussian's own axes, or as 3DGS moves them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pipeline.render import Backend, FrameAdam, Gradients, ShAdam, make_backend
from pipeline.splats.gaussians import Gaussians, resize_bands

BETA2 = 0.999
# 3DGS's: gradients of a mean over all pixels are far below the usual 1e-8.
EPSILON = 1e-15


@dataclass(frozen=True)
class Rates:
    """Learning rates of one step; ``means`` counts in each Gaussian's own scales where Adam has
    ``own_frames``, else in the world's unit."""

    means: float
    log_scales: float
    quats: float
    opacity_logits: float
    sh0: float
    shN: float


class Adam:
    """First and second moments beside a ``Gaussians``, row by row.

    Attributes:
        beta1: of the first moment.
        backend: takes the steps.
        own_frames: means and rotations are moved along and about each Gaussian's own axes.
        first, second: by the name of the array, of its shape, float32. But with ``own_frames``
            those of quaternions are (N, 3), about the axes; and without, the second of means and
            of quaternions (N, 1): a turned world is trained as it was, either way.
        last: (N,) int32, the last step whose view asked anything of each row.
    """

    def __init__(
        self, gaussians: Gaussians, beta1: float, own_frames: bool, backend: Backend | None = None
    ):
        self.backend = backend or make_backend()
        self.beta1, self.own_frames = beta1, own_frames
        tensors = gaussians.tensors()
        self.first = {name: torch.zeros_like(tensor) for name, tensor in tensors.items()}
        self.second = {name: torch.zeros_like(tensor) for name, tensor in tensors.items()}
        count = len(gaussians)
        if own_frames:
            self.first["quats"] = torch.zeros(count, 3)
            self.second["quats"] = torch.zeros(count, 3)
        else:
            self.second["means"] = torch.zeros(count, 1)
            self.second["quats"] = torch.zeros(count, 1)
        self.last = torch.zeros(count, dtype=torch.int32)

    def harmonics(self, rates: Rates, step: int) -> ShAdam:
        """For ``backward``, which moves ``sh``; ``step`` counts from 1."""
        return ShAdam(
            self.first["sh"], self.second["sh"], self.last, rates.sh0, rates.shN, step,
            self.beta1, BETA2, EPSILON,
        )  # fmt: skip

    def step(
        self, gaussians: Gaussians, gradients: Gradients, rates: Rates, step: int, threads: int
    ) -> None:
        """Move all of ``gaussians`` but ``sh``, in place; ``step`` counts from 1."""
        moved = {"sh"}
        if self.own_frames:
            moved |= {"means", "quats"}
            self.backend.frame_adam(
                gaussians.means, gaussians.quats, gaussians.log_scales, gradients.means,
                gradients.quats, self.frames(rates, step), threads,
            )  # fmt: skip
        for name, parameter in gaussians.tensors().items():
            if name in moved:
                continue
            self.backend.adam_step(
                parameter, getattr(gradients, name), self.first[name], self.second[name],
                getattr(rates, name), step, self.beta1, BETA2, EPSILON, threads,
            )  # fmt: skip

    def frames(self, rates: Rates, step: int) -> FrameAdam:
        return FrameAdam(
            self.first["means"], self.second["means"], self.first["quats"], self.second["quats"],
            rates.means, rates.quats, step, self.beta1, BETA2, EPSILON,
        )  # fmt: skip

    def select(self, rows: Tensor, fresh: Tensor) -> None:
        """Follow ``Gaussians.select(rows)``; rows marked in ``fresh`` (M,) start from zero."""
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
        """Follow ``Gaussians.with_sh_degree``."""
        for moments in (self.first, self.second):
            moments["sh"] = resize_bands(moments["sh"], degree)
