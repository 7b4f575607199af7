"""The accuracy of keypoints by the residuals of a robust bundle adjustment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Bounds of the scale of the loss, pixels: keypoints are hardly more accurate than the first.
LOSS_PX = (0.05, 1.0)
#: Tracks with a residual of more than so many times the median one do not move the cameras.
RELIABLE_RESIDUALS = 5.0
#: Each photograph is divided into this number of cells along each side to measure correlations.
CELLS = 4
#: Standard deviations of poses over what independent errors give, on photographs that show no
#: correlation (rendered scenes with exact poses): keypoints of a track have errors in common.
COMMON_ERRORS = 2.0
#: Upper bound of the multiplier in ``_independent``, where its equation has a solution.
MAX_MULTIPLIER = 7.5


def keypoint_variance(
    residuals: Sequence[Floats],
    positions: Sequence[Floats],
    *,
    loss_px: float,
    parameters: float,
) -> float:
    """The variance of a coordinate of a keypoint in pixels squared, by which the inverse of the
    normal equations without a robust loss gives the covariance of the adjusted parameters.

    Args:
        residuals: (O, 2) reprojection errors of each photograph, pixels.
        positions: (O, 2) the keypoints as shares of the width and the height.
        loss_px: The scale of the Cauchy loss.
        parameters: The number of adjusted parameters over the number of residuals, below 1.
    """
    if not any(len(r) for r in residuals):
        return 0.0
    weights = [1 / (1 + (r**2).sum(1) / loss_px**2) for r in residuals]
    independent = _independent(np.concatenate(residuals), np.concatenate(weights), parameters)
    weighted = [w[:, None] * r for w, r in zip(weights, residuals, strict=True)]
    return independent * COMMON_ERRORS**2 * (1 + _correlation(weighted, positions))


def _independent(residuals: Floats, weights: Floats, parameters: float) -> float:
    """The variance if errors are independent. Points follow their few keypoints, so that residuals
    are smaller than errors; El Karoui et al. 2013 derive what a robust loss makes of that."""
    # Derivatives of the influence across and along a residual: 1 - 2 s / (1 + s) = 2 w - 1.
    slopes = np.stack([weights, weights * (2 * weights - 1)])
    low, high = 0.0, MAX_MULTIPLIER
    for _ in range(40):
        middle = (low + high) / 2
        below = float((1 / (1 + middle * slopes)).mean()) < 1 - parameters
        low, high = (low, middle) if below else (middle, high)
    influence = float(((weights[:, None] * residuals) ** 2).mean())
    return high**2 * influence * (1 - parameters) / parameters**2


def _correlation(influences: Sequence[Floats], positions: Sequence[Floats]) -> float:
    """Mean correlation of a keypoint's error with those of others in its cell, times their number:
    0 if errors are independent."""
    together, apart, cells = 0.0, 0.0, 0
    for influence, position in zip(influences, positions, strict=True):
        column, row = np.clip((position * CELLS).astype(np.int64), 0, CELLS - 1).T
        cell = row * CELLS + column
        for values in influence.T:
            together += float((np.bincount(cell, values, CELLS**2) ** 2).sum())
            apart += float((values**2).sum())
        cells += len(np.unique(cell))
    # The six parameters of each pose lower the sums over its cells.
    left = max(1 - 6 * len(influences) / (2 * cells), 0.5)
    return max(together / max(apart * left, 1e-300) - 1, 0.0)


def image_residuals(
    model: pycolmap.Reconstruction, image: pycolmap.Image, points: Mapping[int, Floats]
) -> tuple[NDArray[np.int64], Floats]:
    """The ids of the points that an image observes, (O,), and their reprojection errors in pixels,
    (O, 2).

    Args:
        points: The positions of all points of the model by their ids.
    """
    seen = image.get_observation_points2D()
    ids = np.array([point.point3D_id for point in seen], np.int64)
    if not seen:
        return ids, np.empty((0, 2))
    local = image.cam_from_world() * np.array([points[i] for i in ids.tolist()])
    projected = np.asarray(model.camera(image.camera_id).img_from_cam(local)).reshape(-1, 2)
    return ids, projected - np.array([point.xy for point in seen])


def loss_scale(model: pycolmap.Reconstruction) -> float:
    """The scale of the loss in pixels that fits the errors of the points of a model."""
    return float(np.clip(median_error(model), *LOSS_PX))


def median_error(model: pycolmap.Reconstruction) -> float:
    """Median over the points of the mean reprojection error, pixels; 0 without points."""
    errors = [point.error for point in model.points3D.values()]
    return float(np.median(errors)) if errors else 0.0
