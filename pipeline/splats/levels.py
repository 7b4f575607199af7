"""Levels of detail: pairs of Gaussians are merged into one that looks the same from afar.

The merged Gaussian has the mean and the covariance of the pair, weighted by opacity times mean
projected area, or by given weights. Its opacity keeps that product. Pairs are chosen by Runnalls's
bound of the information that a merge loses (Runnalls 2007, "Kullback-Leibler approach to Gaussian
mixture reduction", equation 21), and by the difference of colours. Importing this module does not
import torch.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.rotations import quat_to_rotation, rotation_to_quat
from pipeline.splats.arrays import CHUNK, GaussianArrays

Doubles = NDArray[np.float64]
Pairs = NDArray[np.int64]

# The number of nearest neighbours that a Gaussian may be merged with.
_NEIGHBOURS = 8
# The cost of a difference of 1 of the harmonics of degree 0, in nats.
_COLOUR = 4.0
# Rounds of matching with the same neighbours, and with new ones.
_ROUNDS, _PASSES = 8, 20
# The largest share of the Gaussians that a pass of ``merged_to`` merges away: few enough that the
# costs of other pairs hold.
_SHARE = 1 / 3
# The exponent of Thomsen's approximation of an ellipsoid's surface, four times its mean projection.
_THOMSEN = 1.6075
_MAX_OPACITY = 0.9999
# Added to variances, as a share of the largest: flat Gaussians have a finite entropy.
_FLATTEST = 1e-8


def halved(gaussians: GaussianArrays) -> GaussianArrays:
    """Half as many Gaussians, rounded up, which look the same from afar. The result has no
    meaningful order."""
    target = (len(gaussians) + 1) // 2
    for _ in range(_PASSES):
        if len(gaussians) <= target:
            break
        gaussians, _ = _merged(gaussians, len(gaussians) - target)
    return gaussians


def merged_to(gaussians: GaussianArrays, count: int, weights: Doubles) -> GaussianArrays:
    """At most ``count`` Gaussians, which look like all of them.

    Args:
        weights: (N,) positive, what each adds to the pictures that matter. Pairs of small weights
            are merged first, and the mean, covariance and colour of a pair are weighted by them.
    """
    while len(gaussians) > count:
        most = min(len(gaussians) - count, max(1, int(_SHARE * len(gaussians))))
        before = len(gaussians)
        gaussians, weights = _merged(gaussians, most, weights)
        if len(gaussians) == before:
            break
    return gaussians


def _merged(
    gaussians: GaussianArrays, most: int, weights: Doubles | None = None
) -> tuple[GaussianArrays, Doubles]:
    """The Gaussians after up to ``most`` merges of disjoint pairs, the cheapest first, and their
    weights."""
    moments = _Moments(gaussians, weights)
    pairs, costs = _matched(*_candidates(gaussians, moments), len(gaussians))
    pairs = pairs[np.argsort(costs, kind="stable")[:most]]
    alone = np.ones(len(gaussians), bool)
    alone[pairs] = False
    made = [_merge(gaussians, moments, pairs[i : i + CHUNK]) for i in range(0, len(pairs), CHUNK)]
    parts = [{name: values[alone] for name, values in gaussians.arrays().items()}, *made]
    found = GaussianArrays(**{name: np.concatenate([p[name] for p in parts]) for name in parts[0]})
    return found, np.concatenate([moments.weights[alone], moments.weights[pairs].sum(1)])


class _Moments:
    """The masses and weights (N,) and covariances (N, 3, 3) of Gaussians, and the logarithm (N,) of
    the covariances' determinants. Weights are the masses (``weights_of``) if not given."""

    def __init__(self, gaussians: GaussianArrays, weights: Doubles | None = None) -> None:
        self.masses = weights_of(gaussians)
        self.weights = self.masses if weights is None else weights
        self.covariances = np.empty((len(gaussians), 3, 3))
        for start in range(0, len(gaussians), CHUNK):
            rows = slice(start, start + CHUNK)
            quats = gaussians.quats[rows].astype(np.float64)
            norms = np.linalg.norm(quats, axis=1, keepdims=True)
            quats = np.where(norms > 0, quats / np.where(norms > 0, norms, 1), (1.0, 0, 0, 0))
            variances = np.exp(2 * gaussians.log_scales[rows].astype(np.float64))
            variances += _FLATTEST * variances.max(1, keepdims=True)
            axes = quat_to_rotation(quats)
            self.covariances[rows] = np.einsum("nij,nj,nkj->nik", axes, variances, axes)
        self.log_dets = _log_dets(self.covariances)


def weights_of(gaussians: GaussianArrays) -> Doubles:
    """(N,) opacities times mean projected areas, up to a factor: what each adds to pictures."""
    opacities = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64).clip(-100, 100)))
    areas = _areas(np.exp(gaussians.log_scales.astype(np.float64).clip(-30, 30)))
    return np.maximum(opacities * areas, 1e-30)


def _areas(scales: Doubles) -> Doubles:
    """(N,) mean projected areas of ellipsoids with these semi-axes (N, 3), up to a factor."""
    a, b, c = (scales[:, i] ** _THOMSEN for i in range(3))
    found: Doubles = ((a * b + a * c + b * c) / 3) ** (1 / _THOMSEN)
    return found


def _log_dets(matrices: Doubles) -> Doubles:
    """(N,) logarithms of the determinants of (N, 3, 3) symmetric matrices."""
    m = matrices
    found = (
        m[:, 0, 0] * (m[:, 1, 1] * m[:, 2, 2] - m[:, 1, 2] ** 2)
        - m[:, 0, 1] * (m[:, 0, 1] * m[:, 2, 2] - m[:, 1, 2] * m[:, 0, 2])
        + m[:, 0, 2] * (m[:, 0, 1] * m[:, 1, 2] - m[:, 1, 1] * m[:, 0, 2])
    )
    return np.log(np.maximum(found, 1e-300))


def _candidates(gaussians: GaussianArrays, moments: _Moments) -> tuple[Pairs, Doubles]:
    """Pairs (P, 2) of neighbours, the lower index first, and their costs (P,)."""
    from scipy.spatial import cKDTree

    count = len(gaussians)
    near = cKDTree(gaussians.means).query(gaussians.means, k=min(_NEIGHBOURS + 1, count))[1]
    own = np.repeat(np.arange(count), near.shape[1])
    codes = np.minimum(own, near.ravel()) * count + np.maximum(own, near.ravel())
    codes = np.unique(codes[own != near.ravel()])
    pairs = np.column_stack([codes // count, codes % count])
    costs = np.empty(len(pairs))
    for start in range(0, len(pairs), CHUNK):
        rows = slice(start, start + CHUNK)
        costs[rows] = _costs(gaussians, moments, pairs[rows])
    return pairs, costs


def _costs(gaussians: GaussianArrays, moments: _Moments, pairs: Pairs) -> Doubles:
    w = moments.weights[pairs]
    _, covariances = _joint(gaussians, moments, pairs)
    spread = w.sum(1) * _log_dets(covariances) - (w * moments.log_dets[pairs]).sum(1)
    first, second = (gaussians.sh[pairs[:, side], 0].astype(np.float64) for side in (0, 1))
    colours = ((first - second) ** 2).sum(1)
    found: Doubles = spread / 2 + _COLOUR * w.prod(1) / w.sum(1) * colours
    return found


def _joint(gaussians: GaussianArrays, moments: _Moments, pairs: Pairs) -> tuple[Doubles, Doubles]:
    """The means (P, 3) and covariances (P, 3, 3) of pairs."""
    w = moments.weights[pairs]
    w = w / w.sum(1, keepdims=True)
    means = gaussians.means[pairs].astype(np.float64)
    apart = means[:, 0] - means[:, 1]
    covariances = np.einsum("pi,pijk->pjk", w, moments.covariances[pairs])
    covariances += w.prod(1)[:, None, None] * apart[:, :, None] * apart[:, None, :]
    return np.einsum("pi,pij->pj", w, means), covariances


def _matched(pairs: Pairs, costs: Doubles, count: int) -> tuple[Pairs, Doubles]:
    """Disjoint pairs, and their costs: in each round, those that are the cheapest of both."""
    free, found, paid = np.ones(count, bool), [np.zeros((0, 2), np.int64)], [np.zeros(0)]
    order = np.argsort(costs, kind="stable")
    pairs, costs = pairs[order], costs[order]
    for _ in range(_ROUNDS):
        left = free[pairs].all(1)
        pairs, costs = pairs[left], costs[left]
        if not len(pairs):
            break
        ranks = np.arange(len(pairs))
        best = np.full(count, len(pairs))
        np.minimum.at(best, pairs.ravel(), np.repeat(ranks, 2))
        chosen = (best[pairs] == ranks[:, None]).all(1)
        free[pairs[chosen]] = False
        found.append(pairs[chosen])
        paid.append(costs[chosen])
    return np.concatenate(found), np.concatenate(paid)


def _merge(
    gaussians: GaussianArrays, moments: _Moments, pairs: Pairs
) -> dict[str, NDArray[np.float32]]:
    """The arrays of the Gaussians that replace the pairs."""
    means, covariances = _joint(gaussians, moments, pairs)
    variances, axes = np.linalg.eigh(covariances)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    scales = np.sqrt(np.maximum(variances, 1e-30))
    w = moments.weights[pairs]
    masses = moments.masses[pairs].sum(1)
    opacities = np.minimum(masses / _areas(scales), _MAX_OPACITY).clip(1e-6)
    shares = w / w.sum(1, keepdims=True)
    found = {
        "means": means,
        "log_scales": np.log(scales),
        "quats": rotation_to_quat(axes),
        "opacity_logits": np.log(opacities / (1 - opacities)),
        "sh": np.einsum("pi,pijk->pjk", shares, gaussians.sh[pairs].astype(np.float64)),
    }
    return {name: values.astype(np.float32) for name, values in found.items()}
