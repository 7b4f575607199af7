"""Similarity transforms between two sets of points: least squares and robust estimation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
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

    def residuals(self, source: Array, target: Array, weight: Array) -> Array:
        """(N, 3) differences of the transformed points from ``target``, weighted along its axes."""
        return np.asarray((self(source) - target) * weight)

    def distances(self, source: Array, target: Array, weight: Array) -> Array:
        """(N,) the lengths of ``residuals``."""
        return np.asarray(np.linalg.norm(self.residuals(source, target, weight), axis=1))


@dataclass(frozen=True)
class Noise:
    """What is known of the errors of measurements before a fit.

    Few measurements fit with residuals near 0 whatever their errors are. The estimate of the
    standard deviation therefore counts the expected one as a number of further residuals.

    Attributes:
        sigma: The expected standard deviation along a horizontal axis, in the target's unit.
        count: The number of residuals that the expectation counts as; 0 if nothing is expected.
        floor: The lower bound of the estimate.
    """

    sigma: float
    count: float = 4.0
    floor: float = 0.0

    def estimate(self, squares: float, freedoms: float) -> float:
        """The standard deviation, from the sum of squared residuals and its degrees of freedom."""
        count = self.count + max(freedoms, 0.0)
        total = self.count * self.sigma**2 + squares
        return max(float(np.sqrt(total / count)) if count > 0 else 0.0, self.floor)


class Uncertainty(NamedTuple):
    """Standard deviations of a fitted similarity.

    Attributes:
        scale: The deviation of the scale, relative to the scale.
        heading: The deviation in radians about the vertical axis.
        tilt: The deviation in radians about the horizontal axis that is determined worst, by the
            points of which all coordinates were measured.
    """

    scale: float
    heading: float
    tilt: float


class RobustFit(NamedTuple):
    """A similarity estimated in the presence of outliers.

    Attributes:
        similarity: The transform from source points to target points.
        inliers: (N,) bool, the points that it was fitted to.
        sigma: The standard deviation of the weighted residuals along one axis of the ground plane,
            in the target's unit.
        observations: The number of measured coordinates of the inliers.
        freedoms: The number of observations less the number of fitted parameters.
        uncertainty: The uncertainty of the similarity, from its covariance.
    """

    similarity: Similarity
    inliers: NDArray[np.bool_]
    sigma: float
    observations: int
    freedoms: int
    uncertainty: Uncertainty


def robust_similarity(
    source: Array, target: Array, weight: Array, noise: Noise
) -> RobustFit | None:
    """Least median of squares over triples of points (Rousseeuw 1984), then iterated least squares
    on the inliers.

    Args:
        source, target: (N, 3) corresponding points, N >= 3.
        weight: (3,) or (N, 3) factors of the residuals along the target's axes; 0 for a coordinate
            that was not measured.
        noise: The expected errors. Points with residuals above ``OUTLIER_SIGMAS`` times the
            estimated standard deviation are outliers.

    Returns:
        None if the source points are collinear or no triple determines a similarity.
    """
    weight = np.broadcast_to(weight, source.shape)
    complete = np.flatnonzero((weight > 0).all(axis=1))
    if len(complete) < 3 or _collinear(source[complete]):
        return None
    proposals = (
        Similarity(*umeyama(source[chosen], target[chosen])) for chosen in _triples(complete)
    )
    similarity = least_median(
        (proposal for proposal in proposals if proposal.scale > 0), source, target, weight
    )
    if similarity is None:
        return None
    inliers = np.ones(len(source), bool)
    for _ in range(10):
        residuals = similarity.distances(source, target, weight)
        near = residuals <= OUTLIER_SIGMAS * spread_of(residuals, weight, noise, 7)
        if near.sum() < 3 or (weight[near] > 0).sum() < 7:
            break
        inliers = near
        refined = _least_squares(source[inliers], target[inliers], weight[inliers], similarity)
        if np.allclose(refined(source), similarity(source), rtol=0, atol=1e-9):
            break
        similarity = refined
    kept = source[inliers], target[inliers], weight[inliers]
    sigma, observations = precision(similarity, *kept, noise, 7)
    uncertainty = _uncertainty(source[inliers], weight[inliers], similarity, sigma)
    # A point without a height changes with the tilt by its cosine only. Where the fit is tilted by
    # mistake, that looks like a measurement of the tilt. A line of heights is none at any tilt.
    tilt = math.inf
    if (whole := inliers & (weight > 0).all(axis=1)).any():
        tilt = _uncertainty(source[whole], weight[whole], similarity, sigma).tilt
    uncertainty = uncertainty._replace(tilt=max(uncertainty.tilt, tilt))
    return RobustFit(similarity, inliers, sigma, observations, observations - 7, uncertainty)


def least_median(
    proposals: Iterable[Similarity], source: Array, target: Array, weight: Array
) -> Similarity | None:
    """The first of the similarities with the least median residual; None without any."""
    scored = ((float(np.median(p.distances(source, target, weight))), p) for p in proposals)
    best = min(scored, key=lambda item: item[0], default=None)
    return best and best[1]


def precision(
    similarity: Similarity,
    source: Array,
    target: Array,
    weight: Array,
    noise: Noise,
    parameters: int,
) -> tuple[float, int]:
    """``RobustFit.sigma`` and ``observations`` of a similarity that was fitted to these points.

    Args:
        parameters: The number of fitted parameters.
    """
    observations = int((weight > 0).sum())
    squares = float((similarity.residuals(source, target, weight) ** 2).sum())
    return noise.estimate(squares, observations - parameters), observations


def spread_of(residuals: Array, weight: Array, noise: Noise, parameters: int) -> float:
    """Robust standard deviation of the weighted residuals along one axis.

    Args:
        residuals: (N,) lengths.
        weight: (N, 3), 0 for a coordinate that was not measured.
        parameters: The number of fitted parameters.
    """
    # 1.1774 is the median of a Rayleigh distribution with sigma 1.
    robust = float(np.median(residuals)) / 1.1774
    freedoms = max(int((weight > 0).sum()) - parameters, 0)
    return noise.estimate(freedoms * robust**2, freedoms)


def _triples(points: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    """All triples of few points, ``NUM_HYPOTHESES`` random ones of many."""
    if math.comb(len(points), 3) <= NUM_HYPOTHESES:
        for triple in itertools.combinations(points.tolist(), 3):
            yield np.array(triple)
        return
    rng = np.random.default_rng(0)
    for _ in range(NUM_HYPOTHESES):
        yield points[rng.choice(len(points), 3, replace=False)]


def _collinear(points: Array) -> bool:
    spread = np.linalg.svd(centred(points), compute_uv=False)
    return bool(spread[1] < 1e-6 * max(float(spread[0]), 1e-300))


def _jacobian(rotated: Array) -> Array:
    """(N, 3, 7) derivatives by rotation vector, log scale and translation of points
    ``rotated`` = s R x."""
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
    return np.concatenate([by_rotation, rotated[:, :, None], by_translation], axis=2)


def _uncertainty(source: Array, weight: Array, similarity: Similarity, sigma: float) -> Uncertainty:
    """Standard deviations from the covariance of the least squares solution."""
    rotated = similarity.scale * centred(source) @ similarity.rotation.T
    jacobian = (_jacobian(rotated) * weight[:, :, None]).reshape(-1, 7)
    # Use units of the extent, so that the eigenvalues of all parameters compare.
    extent = max(float(np.abs(rotated).max()), 1e-300)
    jacobian = jacobian / np.array([extent] * 4 + [1.0] * 3)
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
    values = np.maximum(values, 1e-12)
    covariance = (vectors / values) @ vectors.T * (sigma / extent) ** 2
    tilt = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    scale, heading = covariance[3, 3], covariance[2, 2]
    return Uncertainty(*(float(np.sqrt(max(v, 0.0))) for v in (scale, heading, tilt)))


def _least_squares(source: Array, target: Array, weight: Array, start: Similarity) -> Similarity:
    """Gauss-Newton over rotation vector, log scale and translation from ``start``; residuals are
    weighted along the target's axes."""
    # Imported here because scipy takes long to import.
    from scipy.spatial.transform import Rotation

    scale, rotation, translation = start.scale, start.rotation, start.translation
    for _ in range(20):
        rotated = scale * source @ rotation.T
        residual = (rotated + translation - target) * weight
        jacobian = _jacobian(rotated) * weight[:, :, None]
        step = np.linalg.lstsq(jacobian.reshape(-1, 7), -residual.ravel(), rcond=1e-12)[0]
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        scale *= float(np.exp(np.clip(step[3], -1, 1)))
        translation = translation + step[4:]
        if np.abs(step[:4]).max() < 1e-12:
            break
    return Similarity(scale, rotation, translation)


def centred(points: Array) -> Array:
    """The points less their mean."""
    return np.asarray(points - points.mean(0))


def median_distance(points: Array) -> float:
    """The median distance of the points from their median."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


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
