"""Similarity transforms of points whose vertical axis is known: rotation about it only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.similarity import (
    OUTLIER_SIGMAS,
    Noise,
    RobustFit,
    Similarity,
    Uncertainty,
    centred,
    least_median,
    precision,
    spread_of,
)

Array = NDArray[np.float64]
# Up to this many points, all pairs are tried; of more points, each with at most 30 others.
_ALL_PAIRS = 60


def upright_similarity(
    source: Array, target: Array, weight: Array, noise: Noise, tilt: float
) -> RobustFit | None:
    """A similarity of points with a common vertical axis (z), in the presence of outliers.

    Heading, scale and horizontal translation follow from the horizontal coordinates: pairs of
    points with the least median residual, then least squares on the inliers. The vertical
    translation is the median of the measured heights' differences.

    Args:
        source, target: (N, 3) corresponding points, N >= 2.
        weight: (N, 3) factors of the residuals along the target's axes; 0 for a height that was not
            measured.
        noise: The expected errors.
        tilt: The standard deviation of the vertical axis, radians.

    Returns:
        None if the source points lie above each other.
    """
    known = weight[:, 2] > 0
    flat = source * [1.0, 1.0, 0.0]
    extent = float(np.linalg.norm(centred(flat), axis=1).max())
    if extent < 1e-9 * max(float(np.abs(source).max()), 1e-300):
        return None
    proposals = (_fitted(source, target, pair, known) for pair in _pairs(len(flat)))
    similarity = least_median(proposals, source, target, weight)
    assert similarity is not None
    parameters = 5 if known.any() else 4
    inliers = np.ones(len(source), bool)
    for _ in range(10):
        residuals = similarity.distances(source, target, weight)
        near = residuals <= OUTLIER_SIGMAS * spread_of(residuals, weight, noise, parameters)
        if near.sum() < 2 or (near == inliers).all():
            break
        inliers = near
        similarity = _fitted(source, target, inliers, known & inliers)
    similarity = _fitted(source, target, inliers, known & inliers)
    kept = source[inliers], target[inliers], weight[inliers]
    sigma, observations = precision(similarity, *kept, noise, parameters)
    size = similarity.scale * float(np.linalg.norm(centred(flat[inliers])))
    turn = sigma / max(size, 1e-300)
    freedoms, uncertainty = observations - parameters, Uncertainty(turn, turn, tilt)
    return RobustFit(similarity, inliers, sigma, observations, freedoms, uncertainty)


def _pairs(count: int) -> list[list[int]]:
    step = 1 if count <= _ALL_PAIRS else count // 30
    return [[i, j] for i in range(count) for j in range(i + 1, count, step)]


def _fitted(
    source: Array,
    target: Array,
    chosen: list[int] | NDArray[np.bool_],
    known: NDArray[np.bool_],
) -> Similarity:
    """The similarity that rotates about z, by least squares in the ground plane.

    Args:
        chosen: The points that it is fitted to.
        known: (N,) the points whose heights give the vertical translation; 0 without any.
    """
    means = (source[chosen] * [1.0, 1.0, 0.0]).mean(0), target[chosen].mean(0)
    a, b = centred(source[chosen])[:, :2], centred(target[chosen])[:, :2]
    dot, cross = float((a * b).sum()), float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    size = np.hypot(dot, cross)
    c, s = (dot / size, cross / size) if size > 0 else (1.0, 0.0)
    scale = float(size / max(float((a**2).sum()), 1e-300))
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    translation = means[1] - scale * rotation @ means[0]
    heights = target[known, 2] - scale * source[known, 2]
    translation[2] = np.median(heights) if known.any() else 0.0
    return Similarity(scale, rotation, translation)
