"""Similarities between two sets of points: least squares, and robust to outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
HYPOTHESES = 200
# Beyond so many deviations a position counts as wrong (GPS in a street canyon, a stale fix).
OUTLIER = 3.5


@dataclass(frozen=True)
class Similarity:
    """``new = scale * rotation @ old + translation``, points."""

    scale: float
    rotation: Array
    translation: Array

    def __call__(self, points: Array) -> Array:
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)


Fit = tuple[Similarity, NDArray[np.bool_], float]
"""A similarity, the positions it rests on, and their standard deviation on the ground."""


def robust_similarity(source: Array, target: Array, weight: Array, floor: float) -> Fit | None:
    """The similarity of least median residual over triples (Rousseeuw 1984), then reweighted least
    squares on the inliers; None where the sources determine none.

    Args:
        weight: (3,) of the residuals along the target's axes.
    """
    count = len(source)
    spread = np.linalg.svd(_centred(source), compute_uv=False)
    if spread[1] < 1e-6 * max(float(spread[0]), 1e-300):
        return None
    rng = np.random.default_rng(0)
    best: tuple[float, Similarity] | None = None
    triples = [np.arange(3)] if count == 3 else None
    for k in range(HYPOTHESES if triples is None else 1):
        chosen = rng.choice(count, 3, replace=False) if triples is None else triples[k]
        proposal = Similarity(*umeyama(source[chosen], target[chosen]))
        if proposal.scale <= 0:
            continue
        misses = np.linalg.norm((proposal(source) - target) * weight, axis=1)
        score = float(np.median(misses))
        if best is None or score < best[0]:
            best = (score, proposal)
    if best is None:
        return None
    similarity = best[1]
    used = np.ones(count, bool)
    sigma = floor
    for _ in range(10):
        misses = np.linalg.norm((similarity(source) - target) * weight, axis=1)
        # 1.1774: the median of a Rayleigh distribution of deviation 1.
        sigma = max(float(np.median(misses)) / 1.1774, floor)
        kept = misses <= OUTLIER * sigma
        if kept.sum() < 3:
            break
        used = kept
        refined = _least_squares(source[used], target[used], weight, similarity)
        if np.allclose(refined(source), similarity(source), rtol=0, atol=1e-9):
            break
        similarity = refined
    return similarity, used, sigma


def _least_squares(source: Array, target: Array, weight: Array, start: Similarity) -> Similarity:
    """Gauss-Newton over turn, log scale and shift, residuals weighted along the target's axes."""
    # Not at import time: scipy is heavy.
    from scipy.spatial.transform import Rotation

    scale, rotation, translation = start.scale, start.rotation, start.translation
    for _ in range(20):
        moved = scale * source @ rotation.T
        residual = (moved + translation - target) * weight
        # d(R exp(w) x) = -[Rx]_x w for a turn on the left.
        x, y, z = moved.T
        zero = np.zeros_like(x)
        turn = np.stack(
            [
                np.stack([zero, z, -y], -1),
                np.stack([-z, zero, x], -1),
                np.stack([y, -x, zero], -1),
            ],
            axis=1,
        )
        shift = np.broadcast_to(np.eye(3), (len(x), 3, 3))
        jacobian = np.concatenate([turn, moved[:, :, None], shift], axis=2) * weight[:, None]
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
    """The similarity with the least squared distances: ``target ~ scale * R @ source + t``.

    Umeyama 1991, equations 38-43. Collinear or coincident points leave the rotation (and, where
    all sources coincide, the scale) undetermined: then one of the minimisers is returned, and
    scale 1 for coincident sources.

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
