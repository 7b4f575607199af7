"""Chunks of a scene at several levels of detail, for formats whose viewers load what they show.

A tree of chunks has the blocks of the scene first, then halves at the median along the longest
axis. Nothing is copied: a chunk has the rows of its Gaussians. Importing this module does not
import torch.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.splats.arrays import GaussianArrays
from pipeline.splats.levels import halved
from pipeline.splats.z_order import z_order

Rows = NDArray[np.intp]


@dataclass(frozen=True)
class Chunk:
    """A node of the tree.

    Attributes:
        rows: (N,) indices of its Gaussians.
        children: Chunks that together have the same Gaussians; none for a leaf.
    """

    rows: Rows
    children: tuple[Chunk, ...] = ()


def chunks_of(
    means: NDArray[np.float32], rows: Rows, most: int, blocks: NDArray[np.intp] | None = None
) -> Chunk:
    """The tree of some Gaussians.

    Args:
        means: (M, 3) means of all Gaussians.
        rows: (N,) indices of the Gaussians, at least one.
        most: The largest number of Gaussians of a leaf.
        blocks: (N,) the number of the block that each of ``rows`` belongs to; None for one block.
    """
    if blocks is not None and len(found := np.unique(blocks)) > 1:
        parts = [rows[blocks == number] for number in found]
        return Chunk(rows, tuple(chunks_of(means, part, most) for part in parts))
    if len(rows) <= most:
        return Chunk(rows)
    return Chunk(rows, tuple(chunks_of(means, part, most) for part in _halves(means, rows)))


def levels_of(gaussians: GaussianArrays, count: int) -> Iterator[GaussianArrays]:
    """``count`` levels of detail from the finest, each in Morton order. Each level has half as many
    Gaussians as the one before, rounded up."""
    for level in range(count):
        if level and len(gaussians) > 1:
            gaussians = halved(gaussians)
        gaussians = in_z_order(gaussians)
        yield gaussians


def in_z_order(gaussians: GaussianArrays) -> GaussianArrays:
    """The Gaussians along a Z-order curve, which makes files smaller."""
    order = z_order(gaussians.means)
    return GaussianArrays(**{n: values[order] for n, values in gaussians.arrays().items()})


def box(gaussians: GaussianArrays, deviations: float) -> NDArray[np.float64]:
    """(2, 3) corners of a box along the axes around all Gaussians up to ``deviations`` standard
    deviations."""
    quats = gaussians.quats.astype(np.float64)
    quats[(quats == 0).all(1)] = (1, 0, 0, 0)
    axes = quat_to_rotation(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    variances = np.exp(2 * gaussians.log_scales.astype(np.float64))
    # The standard deviation along each axis of the world.
    reach = deviations * np.sqrt(np.einsum("nij,nj->ni", axes**2, variances))
    means = gaussians.means.astype(np.float64)
    return np.stack([(means - reach).min(0), (means + reach).max(0)])


def _halves(means: NDArray[np.float32], rows: Rows) -> tuple[Rows, Rows]:
    """The rows on both sides of the median along the longest axis."""
    found = means[rows]
    axis = int((found.max(0) - found.min(0)).argmax())
    order = np.argsort(found[:, axis], kind="stable")
    middle = len(rows) // 2
    return rows[order[:middle]], rows[order[middle:]]
