"""Gaussians as they are exported: fewer, or with fewer bands."""

from __future__ import annotations

from pipeline.runtime.errors import UserError
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.morton import in_morton_order


def prepare(
    gaussians: Gaussians, sh_degree: int, min_opacity: float, morton_order: bool
) -> Gaussians:
    """The Gaussians as they are exported: SH bands above ``sh_degree`` cut, those fainter than
    ``min_opacity`` left out, and sorted if asked for.

    Raises:
        UserError: none are left.
    """
    if sh_degree < gaussians.sh_degree:
        gaussians = gaussians.with_sh_degree(sh_degree)
    if min_opacity > 0:
        kept = gaussians.opacity_logits.sigmoid() >= min_opacity
        if not kept.any():
            raise UserError(
                f"all {len(gaussians)} Gaussians are fainter than {min_opacity}",
                fix="lower min_opacity",
            )
        gaussians = gaussians.select(kept)
    return in_morton_order(gaussians) if morton_order else gaussians
