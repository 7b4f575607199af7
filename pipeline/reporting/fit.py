"""Gaussians that fit a page: what is left out, when they are too many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.io.spz import encode_spz
from pipeline.splats.gaussians import Gaussians

# Gaussians that tell how far all of them can be compressed, and what that may err by.
_SAMPLE = 20_000
_MARGIN = 0.95


@dataclass(frozen=True)
class Packed:
    """Gaussians as an SPZ file's bytes; how many there are, and the degree of their SH."""

    spz: bytes
    count: int
    sh_degree: int


def fit(gaussians: Gaussians, centres: NDArray[np.float64], room: int) -> Packed:
    """Compress Gaussians into about ``room`` bytes at most, leaving out what is missed least.

    Bands of spherical harmonics go first, then the Gaussians that look smallest and faintest: at
    the same size, a scene without SH came closer to the whole one than a scene with fewer
    Gaussians did (33.7 to 26.7 dB, and 31.1 to 22.5 dB, on two scenes from photographs).

    Args:
        centres: (C, 3) the cameras' centres in the world.
        room: bytes.
    """
    sample = gaussians.select(torch.arange(0, len(gaussians), max(len(gaussians) // _SAMPLE, 1)))
    for degree in range(gaussians.sh_degree, -1, -1):
        each = len(encode_spz(sample.with_sh_degree(degree))) / len(sample)
        fitting = max(int(room * _MARGIN / each), 0)
        if fitting >= len(gaussians):
            break
    kept = gaussians.with_sh_degree(degree)
    if fitting < len(kept):
        rank = prominence(kept, centres).argsort(descending=True, stable=True)
        kept = kept.select(rank[:fitting].sort().values)
    return Packed(encode_spz(kept), len(kept), degree)


def prominence(gaussians: Gaussians, centres: NDArray[np.float64]) -> Tensor:
    """(N,) opacity times the angle each Gaussian spans, as seen by the cameras.

    The angle is taken from its two longer axes and the mean of 1 / distance^2. Ranked by opacity
    times area, without the root or without the distance, what is left looks worse.
    """
    # A few dozen cameras tell where cameras are.
    some = torch.from_numpy(centres[:: max(len(centres) // 64, 1)]).float()
    inverse = torch.zeros(len(gaussians))
    for centre in some:
        inverse += 1 / (gaussians.means - centre).square().sum(1).clamp(min=1e-12)
    longer = gaussians.log_scales.sort(1).values[:, 1:].sum(1)
    return gaussians.opacity_logits.sigmoid() * (longer.exp() * inverse / max(len(some), 1)).sqrt()
