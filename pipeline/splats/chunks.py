"""Parts of a scene for viewers that load what a camera needs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.splats.arrays import GaussianArrays
from pipeline.splats.z_order import z_order

Rows = NDArray[np.intp]

#: The largest number of Gaussians of a part.
LEAF = 1 << 17


def halves(means: NDArray[np.float32], rows: Rows) -> tuple[Rows, Rows]:
    """The rows on both sides of the median along the longest axis."""
    found = means[rows]
    axis = int((found.max(0) - found.min(0)).argmax())
    order = np.argsort(found[:, axis], kind="stable")
    middle = len(rows) // 2
    return rows[order[:middle]], rows[order[middle:]]


def in_z_order(gaussians: GaussianArrays) -> GaussianArrays:
    """The Gaussians along a Z-order curve, which makes files smaller."""
    order = z_order(gaussians.means)
    return GaussianArrays(**{n: values[order] for n, values in gaussians.arrays().items()})


def box(gaussians: GaussianArrays, deviations: float) -> NDArray[np.float64]:
    """(2, 3) corners of a box along the axes around all Gaussians up to ``deviations`` standard
    deviations."""
    quats = gaussians.quats.astype(np.float64)
    quats[(quats == 0).all(1)] = (1, 0, 0, 0)
    axes = np.abs(quat_to_rotation(quats))
    scales = np.exp(gaussians.log_scales.astype(np.float64))
    reach = deviations * np.einsum("nij,nj->ni", axes, scales)
    return np.stack([(gaussians.means - reach).min(0), (gaussians.means + reach).max(0)])
