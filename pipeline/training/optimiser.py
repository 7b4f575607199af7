"""Adam over the five arrays of Gaussians, whose rows come and go."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pipeline.raster import Gradients, adam_step
from pipeline.splats.gaussians import Gaussians, resize_bands

BETA1, BETA2 = 0.9, 0.999
# 3DGS's: gradients of a mean over all pixels are far below the usual 1e-8.
EPSILON = 1e-15


@dataclass(frozen=True)
class Rates:
    """Learning rates of one step; ``means`` is in the world's unit."""

    means: float
    log_scales: float
    quats: float
    opacity_logits: float
    sh0: float
    shN: float


class Adam:
    """First and second moments beside a ``Gaussians``, row by row.

    Attributes:
        first, second: by the name of the array, of its shape, float32.
    """

    def __init__(self, gaussians: Gaussians):
        tensors = gaussians.tensors()
        self.first = {name: torch.zeros_like(tensor) for name, tensor in tensors.items()}
        self.second = {name: torch.zeros_like(tensor) for name, tensor in tensors.items()}

    def step(
        self, gaussians: Gaussians, gradients: Gradients, rates: Rates, step: int, threads: int
    ) -> None:
        """Move ``gaussians`` in place; ``step`` counts from 1 (bias correction)."""
        sh = gaussians.sh
        rest = sh.shape[1] > 1
        dc = sh[:, 0].clone() if rest else None
        for name, parameter in gaussians.tensors().items():
            rate = (rates.shN if rest else rates.sh0) if name == "sh" else getattr(rates, name)
            adam_step(
                parameter,
                getattr(gradients, name),
                self.first[name],
                self.second[name],
                rate,
                step,
                BETA1,
                BETA2,
                EPSILON,
                threads,
            )
        if dc is not None:
            # The constant coefficient shares array and moments, but has a rate of its own.
            scale = self.second["sh"][:, 0].clone().div_(1 - BETA2**step).sqrt_().add_(EPSILON)
            move = self.first["sh"][:, 0].clone().div_(scale)
            sh[:, 0] = dc.sub_(move, alpha=rates.sh0 / (1 - BETA1**step))

    def select(self, rows: Tensor, fresh: Tensor) -> None:
        """Follow ``Gaussians.select(rows)``; rows marked in ``fresh`` (M,) start from zero."""
        for moments in (self.first, self.second):
            for name, tensor in moments.items():
                moments[name] = tensor[rows].contiguous()
                moments[name][fresh] = 0.0

    def forget(self, name: str) -> None:
        """Zero the moments of one array."""
        self.first[name].zero_()
        self.second[name].zero_()

    def resize_bands(self, degree: int) -> None:
        """Follow ``Gaussians.with_sh_degree``."""
        for moments in (self.first, self.second):
            moments["sh"] = resize_bands(moments["sh"], degree)
