"""Morton (Z-order) sorting of Gaussians, which places neighbours in space near each other in
memory."""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.splats.gaussians import Gaussians
from pipeline.splats.z_order import z_order


def morton_order(means: Tensor, threads: int = 1) -> Tensor:
    """(N,) int64 indices that sort ``means`` (N, 3) as ``z_order``."""
    return torch.from_numpy(z_order(means.detach().numpy(), threads))


def in_morton_order(gaussians: Gaussians) -> Gaussians:
    """The Gaussians sorted by ``morton_order``."""
    return gaussians.select(morton_order(gaussians.means))
