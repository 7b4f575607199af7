"""Similarity transforms between two sets of points: least squares and robust estimation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
NUM_HYPOTHESES = 200
# Points with residuals above this many standard deviations are outliers.
OUTLIER_SIGMAS = 3.5


@dataclass(frozen=True)
class Similarity:
    """``y = scale * rotation @ x + translation``. Calling it transforms (N, 3) points.

    Attributes:
        rotation: (3, 3), proper.
        translation: (3,) in the target's unit.
    """

    scale: float
    rotation: Array
    translation: Array

    def __call__(self, points: Array) -> Array:
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)


class RobustFit(NamedTuple):
    """A similarity estimated in the presence of outliers.

    Attributes:
        similarity: maps source points to target points.
        inliers: (N,) bool, the points that it was fitted to.
        sigma: standard deviation of the weighted residuals along one axis of the ground plane,
            from their median; in the target's unit.
    """

    similarity: Similarity
    inliers: NDArray[np.bool_]
    sigma: float


def robust_similarity(
    source: Array, target: Array, weight: Array, min_sigma: float
) -> RobustFit | None:
    """Least median of squares over triples of points (Rousseeuw 1984), then iterated least squares
    on the inliers.

    Args:
        source, target: (N, 3) corresponding points, N >= 3.
        weight: (3,) factors of the residuals along the target's axes.
        min_sigma: lower bound of ``RobustFit.sigma``, in the target's unit. Points with residuals
            above ``OUTLIER_SIGMAS`` times sigma are outliers.

    Returns:
        None if the source points are collinear or no triple determines a similarity.
    """
    count = len(source)
    spread = np.linalg.svd(_centred(source), compute_uv=False)
    if spread[1] < 1e-6 * max(float(spread[0]), 1e-300):
        return None
    rng = np.random.default_rng(0)
    best: tuple[float, Similarity] | None = None
    triples = [np.arange(3)] if count == 3 else None
    for k in range(NUM_HYPOTHESES if triples is None else 1):
        chosen = rng.choice(count, 3, replace=False) if triples is None else triples[k]
        proposal = Similarity(*umeyama(source[chosen], target[chosen]))
        if proposal.scale <= 0:
            continue
        residuals = np.linalg.norm((proposal(source) - target) * weight, axis=1)
        score = float(np.median(residuals))
        if best is None or score < best[0]:
            best = (score, proposal)
    if best is None:
        return None
    similarity = best[1]
    inliers = np.ones(count, bool)
    sigma = min_sigma
    for _ in range(10):
        residuals = np.linalg.norm((similarity(source) - target) * weight, axis=1)
        # 1.1774 is the median of a Rayleigh distribution with sigma 1.
        sigma = max(float(np.median(residuals)) / 1.1774, min_sigma)
        near = residuals <= OUTLIER_SIGMAS * sigma
        if near.sum() < 3:
            break
        inliers = near
        refined = _least_squares(source[inliers], target[inliers], weight, similarity)
        if np.allclose(refined(source), similarity(source), rtol=0, atol=1e-9):
            break
        similarity = refined
    return RobustFit(similarity, inliers, sigma)


def _least_squares(source: Array, target: Array, weight: Array, start: Similarity) -> Similarity:
    """Gauss-Newton over rotation vector, log scale and translation from ``start``; residuals are
    weighted along the target's axes."""
    # Imported here because scipy takes long to import.
    from scipy.spatial.transform import Rotation

    scale, rotation, translation = start.scale, start.rotation, start.translation
    for _ in range(20):
        rotated = scale * source @ rotation.T
        residual = (rotated + translation - target) * weight
        # d(exp([w]_x) y) / dw = -[y]_x at w = 0, for y = s R x.
        x, y, z = rotated.T
        zero = np.zeros_like(x)
        by_rotation = np.stack(
            [
                np.stack([zero, z, -y], -1),
                np.stack([-z, zero, x], -1),
                np.stack([y, -x, zero], -1),
            ],
            axis=1,
        )
        by_translation = np.broadcast_to(np.eye(3), (len(x), 3, 3))
        jacobian = np.concatenate([by_rotation, rotated[:, :, None], by_translation], axis=2)
        jacobian = jacobian * weight[:, None]
        step = np.linalg.lstsq(jacobian.reshape(-1, 7), -residual.ravel(), rcond=1e-12)[0]
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        scale *= float(np.exp(np.clip(step[3], -1, 1)))
        translation = translation + step[4:]
        if np.abs(step[:4]).max() < 1e-12:
            break
    return Similarity(scale, rotation, translation)


def _centred(points: Array) -> Array:
    return points - points.mean(0)


def umeyama(source: Array, target: Array) -> tuple[float, Array, Array]:
    """The similarity ``target ~ scale * R @ source + t`` with the least sum of squared distances.

    Umeyama 1991, equations 38-43. Collinear points leave the rotation undetermined; one of the
    minimisers is returned. If all source points coincide, the scale is 1.

    Args:
        source, target: (N, 3), N >= 1.

    Returns:
        scale (>= 0), R (3, 3) a proper rotation, t (3,).
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    mean_source, mean_target = source.mean(0), target.mean(0)
    centred_source, centred_target = source - mean_source, target - mean_target
    u, d, vt = np.linalg.svd(centred_target.T @ centred_source / len(source))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ np.diag(signs) @ vt
    variance = float((centred_source**2).sum() / len(source))
    scale = max(float(d @ signs) / variance, 0.0) if variance > 0 else 1.0
    return scale, rotation, mean_target - scale * rotation @ mean_source
