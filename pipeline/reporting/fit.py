"""Reduces Gaussians to the size limit of a report page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.io.spz import encode_spz
from pipeline.splats.gaussians import Gaussians

# Size of the sample from which the compressed size is estimated, and a safety factor.
_SAMPLE = 20_000
_MARGIN = 0.95


@dataclass(frozen=True)
class Packed:
    """Gaussians as bytes of an SPZ file, with their number and SH degree."""

    spz: bytes
    count: int
    sh_degree: int


def fit(gaussians: Gaussians, centres: NDArray[np.float64], max_bytes: int) -> Packed:
    """Compress Gaussians to at most about ``max_bytes``.

    Bands of spherical harmonics are dropped first, then the Gaussians of least prominence: at the
    same size, renders without SH are closer to those of the complete scene than renders of fewer
    Gaussians.

    Args:
        centres: (C, 3) camera centres, world.
        max_bytes: size limit.
    """
    sample = gaussians.select(torch.arange(0, len(gaussians), max(len(gaussians) // _SAMPLE, 1)))
    for degree in range(gaussians.sh_degree, -1, -1):
        each = len(encode_spz(sample.with_sh_degree(degree))) / len(sample)
        number = max(int(max_bytes * _MARGIN / each), 0)
        if number >= len(gaussians):
            break
    reduced = gaussians.with_sh_degree(degree)
    if number < len(reduced):
        rank = prominence(reduced, centres).argsort(descending=True, stable=True)
        reduced = reduced.select(rank[:number].sort().values)
    return Packed(encode_spz(reduced), len(reduced), degree)


def prominence(gaussians: Gaussians, centres: NDArray[np.float64]) -> Tensor:
    """(N,) opacity times the angle each Gaussian spans, as seen by the cameras.

    The angle is the square root of the product of the two longer axes and the mean of
    1 / distance^2.
    """
    # A sample of the cameras is enough.
    some = torch.from_numpy(centres[:: max(len(centres) // 64, 1)]).float()
    inverse = torch.zeros(len(gaussians))
    for centre in some:
        inverse += 1 / (gaussians.means - centre).square().sum(1).clamp(min=1e-12)
    longer = gaussians.log_scales.sort(1).values[:, 1:].sum(1)
    return gaussians.opacity_logits.sigmoid() * (longer.exp() * inverse / max(len(some), 1)).sqrt()
