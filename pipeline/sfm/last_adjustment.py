"""The last bundle adjustment, by the keypoints that fit best.

Residuals of SIFT keypoints have heavy tails: those of large scales and at edges of occlusion are
several times less accurate than the others. A Cauchy loss of the scale of the median residual gives
them little weight.
"""

from __future__ import annotations

from collections.abc import Set

import numpy as np
import pycolmap

from pipeline.sfm.refine import EXACT_PX, bundle_adjust

#: Observations with a larger reprojection error, and those behind their camera, are removed
#: (COLMAP: ``filter_max_reproj_error``).
MAX_REPROJECTION_PX = 4.0
#: Bounds of the scale of the loss, pixels: keypoints are hardly more accurate than the first.
LOSS_PX = (0.05, 1.0)


def adjust_last(
    model: pycolmap.Reconstruction,
    free_principal_points: Set[int] = frozenset(),
    *,
    cameras: bool = True,
) -> tuple[pycolmap.Reconstruction, str]:
    """Remove gross outliers and adjust poses, points and cameras with a narrow robust loss.

    Args:
        model: An adjusted model, which is not changed.
        free_principal_points: The ids of the cameras whose principal points are refined.
        cameras: Whether focal lengths and distortions are refined.

    Returns:
        The model and a sentence for the log.
    """
    adjusted = pycolmap.Reconstruction(model)
    removed = pycolmap.ObservationManager(adjusted).filter_all_points3D(MAX_REPROJECTION_PX, 0.0)
    adjusted.update_point_3d_errors()
    errors = [point.error for point in adjusted.points3D.values()]
    error = float(np.median(errors)) if errors else 0.0
    if error < EXACT_PX:
        return adjusted, f"{removed} outliers removed; the other tracks fit exactly"
    loss = float(np.clip(error, *LOSS_PX))
    bundle_adjust(adjusted, free_principal_points, focal=cameras, distortion=cameras, loss_px=loss)
    return adjusted, (
        f"last bundle adjustment with a Cauchy loss of {loss:.2f} px, {removed} outliers removed"
    )
