"""The union of trained blocks: each Gaussian is in exactly one."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch

from pipeline.scene.blocks import Partition
from pipeline.splats.gaussians import Gaussians, concat


def far_field(scene: Gaussians, partition: Partition, number: int) -> Gaussians:
    """The Gaussians of a scene beyond its bounds in the box of block ``number``. All blocks see
    them behind their own: none may change them while others are trained."""
    means = scene.means.numpy()
    found = partition.box(number).contains(means) & ~partition.bounds.contains(means)
    return scene.select(torch.from_numpy(np.flatnonzero(found)))


def inside(trained: Gaussians, partition: Partition, number: int) -> Gaussians:
    """The Gaussians of block ``number`` without those that its training left outside of its box:
    in the margin, which other blocks train as well."""
    within = partition.box(number).contains(trained.means.numpy())
    return trained.select(torch.from_numpy(np.flatnonzero(within)))


def union(parts: Iterable[Gaussians]) -> Gaussians:
    """All Gaussians, of the highest SH degree among the parts."""
    found = list(parts)
    degree = max(part.sh_degree for part in found)
    return concat([part.with_sh_degree(degree) for part in found])
