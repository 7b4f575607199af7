"""Appearance embeddings before training, from the colours of points and of whole photographs.

The log2 of the colour of point p in photograph v, after gains that compensate exposure, is

    m_p + sum_k w_vk a_pk,

with the embedding w_v of the photograph and the mean colour m_p and the colours a_pk of the point.
It is solved by alternating least squares with a small ridge. Photographs in very different light
have few points in common: the means and the contrasts of whole photographs count as points that all
photographs observe.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.photos.disagreement import ObservedColours, observed_colours
from pipeline.photos.load import load_view
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View

Array = NDArray[np.float64]

ROUNDS = 30
# The ridge, as a number of observations.
RIDGE = 3.0
# The weight of the statistics of a whole photograph, as a share of its observations' weight.
STATISTICS_SHARE = 0.1
# The largest number of observations of a photograph that are used.
MAX_OBSERVATIONS = 400


def initial_embeddings(
    views: Sequence[View],
    model: Reconstruction,
    points: Array,
    gains: Array | None,
    size: int,
) -> Array:
    """(V, size) embeddings of mean 0: photographs in similar light start with similar embeddings.

    The numbers are uncorrelated, in the order of their effect. The first has a standard deviation
    of 1 over the views, or all are 0 if the photographs do not differ.

    Args:
        views, points: See ``colour_disagreement``.
        gains: (V, 3) gains that compensate exposure; None: all 1.
    """
    found = _thinned(observed_colours(views, model, points), len(views))
    statistics = np.array([_statistics(view) for view in views])
    exposure = np.zeros((len(views), 3)) if gains is None else np.log2(gains)
    rows = np.arange(len(views))
    _, point = np.unique(found.point, return_inverse=True)
    count = int(point.max(initial=-1)) + 1
    colours = found.colours - exposure[found.view]
    share = STATISTICS_SHARE * max(len(point) / len(views), 1.0)
    weights = np.concatenate([np.ones(len(point)), np.full(2 * len(views), share / 2)])
    return _factors(
        np.concatenate([point, np.full(len(views), count), np.full(len(views), count + 1)]),
        np.concatenate([found.view, rows, rows]),
        np.concatenate([colours, statistics[:, 0] - exposure, statistics[:, 1] - exposure]),
        weights,
        len(views),
        size,
    )


def _thinned(found: ObservedColours, views: int) -> ObservedColours:
    """Observations of points that several views observe, at most ``MAX_OBSERVATIONS`` a view."""
    _, point, observed = np.unique(found.point, return_inverse=True, return_counts=True)
    several = np.flatnonzero(observed[point] >= 2)
    kept = []
    for view in range(views):
        of_view = several[found.view[several] == view]
        # Points that many views observe first: they connect the views.
        order = np.argsort(-observed[point[of_view]], kind="stable")
        kept.append(of_view[order[:MAX_OBSERVATIONS]])
    rows = np.concatenate(kept)
    return ObservedColours(found.point[rows], found.view[rows], found.colours[rows])


def _factors(
    point: NDArray[np.int64],
    view: NDArray[np.int64],
    y: Array,
    weight: Array,
    views: int,
    size: int,
) -> Array:
    """(V, size) numbers w of the views in the model of this module.

    Args:
        point, view: (M,) indices of the observations.
        y: (M, 3) log2 colours.
        weight: (M,) weights of the observations.
    """
    w = np.random.default_rng(0).normal(size=(views, size))
    for _ in range(ROUNDS):
        w = _normalized(w)
        constant = np.concatenate([w, np.ones((views, 1))], axis=1)
        a = _solve(point, constant[view], y, weight)
        slopes = a[:, :size][point]
        rest = y - a[:, size][point]
        w = _solve_views(view, slopes, rest, weight, views)
    covariance = np.einsum("pic,pjc->ij", a[:, :size], a[:, :size]) / len(a)
    return _ordered(w - w.mean(0), covariance)


def _normalized(w: Array) -> Array:
    """Numbers of mean 0 and standard deviation 1 over the views."""
    w = w - w.mean(0)
    return np.asarray(w / np.maximum(w.std(0), 1e-9))


def _solve(point: NDArray[np.int64], x: Array, y: Array, weight: Array) -> Array:
    """(P, K + 1, 3) coefficients of each point, by least squares over its observations."""
    count, size = int(point.max()) + 1, x.shape[1]
    normal = np.empty((count, size, size))
    right = np.empty((count, size, 3))
    for i in range(size):
        for j in range(i, size):
            normal[:, i, j] = np.bincount(point, weight * x[:, i] * x[:, j], count)
            normal[:, j, i] = normal[:, i, j]
        for c in range(3):
            right[:, i, c] = np.bincount(point, weight * x[:, i] * y[:, c], count)
    ridge = np.full(size, RIDGE)
    ridge[-1] = 1e-6  # Mean colours are free.
    return np.asarray(np.linalg.solve(normal + np.diag(ridge), right))


def _solve_views(
    view: NDArray[np.int64], slopes: Array, y: Array, weight: Array, views: int
) -> Array:
    """(V, K) numbers of each view, by least squares over its observations in all channels."""
    size = slopes.shape[1]
    normal, right = np.empty((views, size, size)), np.empty((views, size, 1))
    scale = max(float((slopes**2).mean()), 1e-12)
    for i in range(size):
        right[:, i, 0] = np.bincount(view, weight * (slopes[:, i] * y).sum(1), views)
        for j in range(i, size):
            products = (slopes[:, i] * slopes[:, j]).sum(1)
            normal[:, i, j] = np.bincount(view, weight * products, views)
            normal[:, j, i] = normal[:, i, j]
    return np.asarray(np.linalg.solve(normal + RIDGE * scale * np.eye(size), right)[..., 0])


def _ordered(w: Array, covariance: Array) -> Array:
    """The same numbers, rotated to be uncorrelated in their effect, which has the covariance
    ``covariance`` (K, K) for numbers of 1."""
    variances, axes = np.linalg.eigh(covariance)
    effect = np.einsum("vk,ki->vi", w, axes) * np.sqrt(np.maximum(variances, 0))
    spread, axes = np.linalg.eigh(np.einsum("vi,vj->ij", effect, effect) / len(w))
    axes = axes[:, ::-1]
    axes = axes * np.where(axes[np.abs(axes).argmax(0), range(len(axes))] < 0, -1, 1)
    components = np.einsum("vi,ik->vk", effect, axes)
    return np.asarray(components / max(float(np.sqrt(max(spread[-1], 0))), 1e-6))


def _statistics(view: View) -> Array:
    """(2, 3) log2 of the mean and of the standard deviation of each channel, unmasked."""
    pixels = load_view(view)
    rgb = pixels.rgb.reshape(-1, 3) if pixels.mask is None else pixels.rgb[pixels.mask]
    if not len(rgb):
        return np.zeros((2, 3))
    values = rgb / 255.0
    return np.log2(np.stack([values.mean(0), values.std(0)]) + 1 / 255)
