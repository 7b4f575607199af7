"""Reduction of Gaussians for export: fewer Gaussians or SH bands, sorted."""

from __future__ import annotations

import numpy as np

from pipeline.runtime.errors import UserError
from pipeline.splats.arrays import GaussianArrays, GaussianRows
from pipeline.splats.z_order import z_order


def reduce_gaussians(
    gaussians: GaussianArrays,
    sh_degree: int,
    min_opacity: float,
    morton_order: bool,
    num_invented: int = 0,
) -> GaussianRows:
    """Remove SH bands above ``sh_degree`` and Gaussians with an opacity below ``min_opacity``, and
    optionally sort along a Z-order curve.

    Args:
        num_invented: The number of invented Gaussians, the last ones; they stay the last ones.

    Raises:
        UserError: No Gaussian is left.
    """
    rows = np.arange(len(gaussians))
    if min_opacity > 0:
        opacity = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64).clip(-100, 100)))
        rows = np.flatnonzero(opacity >= min_opacity)
        if not len(rows):
            raise UserError(
                f"all {len(gaussians)} Gaussians have an opacity below {min_opacity}",
                fix="lower min_opacity",
            )
    if morton_order:
        trained = rows < len(gaussians) - num_invented
        parts = rows[trained], rows[~trained]
        rows = np.concatenate([part[z_order(gaussians.means[part])] for part in parts])
    return GaussianRows(gaussians, rows, min(sh_degree, gaussians.sh_degree))
