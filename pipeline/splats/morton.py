"""Morton (Z-order) sorting of Gaussians, which places neighbours in space near each other in
memory and in files."""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.splats.gaussians import Gaussians

_BITS = 21  # Three coordinates fit into 63 bits.


def morton_order(means: Tensor) -> Tensor:
    """(N,) int64 indices that sort ``means`` (N, 3) along a Z-order curve through their bounding
    box, which has 2^21 cells per side; the sort is stable."""
    if not len(means):
        return torch.zeros(0, dtype=torch.int64)
    low, high = means.double().aminmax(dim=0)
    size = (high - low).clamp(min=1e-30)
    cells = ((means - low) / size * (2**_BITS - 1)).long()
    code = _spread(cells[:, 0]) | _spread(cells[:, 1]) << 1 | _spread(cells[:, 2]) << 2
    return code.argsort(stable=True)


def in_morton_order(gaussians: Gaussians) -> Gaussians:
    """The Gaussians sorted by ``morton_order``."""
    return gaussians.select(morton_order(gaussians.means))


def _spread(values: Tensor) -> Tensor:
    """Insert two zero bits before each of the 21 bits of (N,) int64 values."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | values << shift) & mask
    return values
