"""The share of each pixel of a view that blocks explain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.render import Backend, Forward, RasterCamera, RasterOptions
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.init import SH_C0

# Views are rendered at 1 / this of their size.
IMAGE_FACTOR = 4
# A block is seen in the pixels of which it explains more than this share.
SHOWN_SHARE = 0.02

Shares = list[NDArray[np.float32]]


def explained_shares(
    grey: Gaussians,
    regions: Sequence[NDArray[np.bool_]],
    camera: RasterCamera,
    options: RasterOptions,
    backend: Backend,
) -> tuple[Shares, Forward]:
    """(h, w) share of each pixel that the Gaussians of each region explain, in front of all others;
    and a render of all Gaussians, for its depths.

    Args:
        grey: All Gaussians, of SH degree 0.
        regions: (N,) bool each, at least one.
        options: The options of rendering, of SH degree 0 and without a background.
    """
    white = 0.5 / SH_C0
    shares: Shares = []
    # Three regions at a time are colour channels.
    for start in range(0, len(regions), 3):
        some = regions[start : start + 3]
        sh = torch.full((len(grey), 1, 3), -white)
        for channel, region in enumerate(some):
            sh[torch.from_numpy(region), 0, channel] = white
        found = backend.forward(*replace(grey, sh=sh).parameters(), camera, options)
        shares += [found.color[..., channel].numpy() for channel in range(len(some))]
    return shares, found
