"""Reduction of Gaussians for export: fewer Gaussians or SH bands, sorted."""

from __future__ import annotations

from pipeline.runtime.errors import UserError
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.morton import in_morton_order


def reduce_gaussians(
    gaussians: Gaussians, sh_degree: int, min_opacity: float, morton_order: bool
) -> Gaussians:
    """Remove SH bands above ``sh_degree`` and Gaussians with an opacity below ``min_opacity``, and
    optionally sort along a Z-order curve.

    Raises:
        UserError: no Gaussian is left.
    """
    if sh_degree < gaussians.sh_degree:
        gaussians = gaussians.with_sh_degree(sh_degree)
    if min_opacity > 0:
        opaque = gaussians.opacity_logits.sigmoid() >= min_opacity
        if not opaque.any():
            raise UserError(
                f"all {len(gaussians)} Gaussians have an opacity below {min_opacity}",
                fix="lower min_opacity",
            )
        gaussians = gaussians.select(opaque)
    return in_morton_order(gaussians) if morton_order else gaussians
