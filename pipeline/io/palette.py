"""Vector quantisation of rows of numbers by k-means with up to 65,536 centroids.

The rows are divided into cells, and the centroids of each cell are found in it. A row is then
assigned to the nearest centroid of the nearest few cells. This takes a small part of the time of a
search of all centroids, and the mean squared error is a few per cent larger.

Distances are computed from rows that are rounded to integers, so small that every partial sum of a
dot product is an exact float32. The order in which a matrix product adds, which depends on the
number of threads and on the processor, does not change the result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Labels = NDArray[np.int64]
Weights = NDArray[np.float64]

# The largest norm of an integer row. With it, |c|^2 - 2 q.c and its partial sums are below 2^24.
_MAX_NORM = 2300.0
# Longer rows than this many times the root mean square are shortened, and assigned by their
# direction: they do not take the resolution of the others.
_OUTLIER = 30.0
# Lloyd's rounds for the cells, and for the centroids of each cell.
_CELL_ROUNDS, _ROUNDS = 6, 3
# The number of rows that the cells are found from, per cell.
_ROWS_PER_CELL = 256
# The number of rows that the centroids are found from, per centroid.
_ROWS_PER_CENTROID = 8
# The number of nearest cells that are searched.
_NEAREST = 8
# The numbers of rows of a matrix product, and of a search.
_BLOCK, _CHUNK = 1024, 1 << 18


@dataclass(frozen=True)
class Palette:
    """Centroids, and the row's centroid of each row.

    Attributes:
        centroids: (K, D) means of the rows of each centroid.
        labels: (N,) indices of centroids. Indices that are near each other belong to one cell.
    """

    centroids: Array
    labels: Labels


def make_palette(rows: Array, weights: Weights, size: int) -> Palette:
    """Quantise ``rows`` (N, D), D up to 45, to at most ``size`` centroids.

    Rows that are near each other in their order should be similar or near in space: training uses
    evenly spaced ones.

    Args:
        weights: (N,) positive weights of the squared errors of the rows. Rows are assigned to the
            nearest centroid, which is their weighted mean.
    """
    count = len(rows)
    if count <= size:
        return Palette(rows.astype(np.float32), np.arange(count))
    scale, longest = _grid(rows)
    chosen = _spread(count, _ROWS_PER_CENTROID * size)
    training = _Rows(_to_integers(rows[chosen], scale, longest), weights[chosen])
    tree = _train(training, size)
    tree = tree.moved(training.means(tree.nearest(training.values), tree.centroids))
    labels = np.empty(count, np.int64)
    for start in range(0, count, _CHUNK):
        chunk = slice(start, start + _CHUNK)
        labels[chunk] = tree.nearest(_to_integers(rows[chunk], scale, longest))
    centroids = tree.centroids / np.float32(scale)
    return Palette(_Rows(rows, weights).means(labels, centroids), labels)


@dataclass(frozen=True)
class _Rows:
    """Rows (N, D), and the weight (N,) of the error of each, which is positive."""

    values: Array
    weights: Weights

    def __getitem__(self, which: Labels) -> _Rows:
        return _Rows(self.values[which], self.weights[which])

    def __len__(self) -> int:
        return len(self.values)

    def means(self, labels: Labels, centroids: Array) -> Array:
        """The means of the rows of each centroid, in float64 and in the order of the rows;
        centroids without rows stay."""
        size = len(centroids)
        total = np.bincount(labels, self.weights, size)
        means = centroids.astype(np.float64)
        for column in range(means.shape[1]):
            sums = np.bincount(labels, self.values[:, column] * self.weights, size)
            means[:, column] = np.where(
                total > 0, sums / np.where(total > 0, total, 1), means[:, column]
            )
        return means.astype(np.float32)


@dataclass(frozen=True)
class _Tree:
    """Centroids in cells.

    Attributes:
        centroids: (K, D) integers.
        starts: (C + 1,) The centroids of cell i are those from ``starts[i]`` to ``starts[i + 1]``.
    """

    centroids: Array
    starts: Labels

    def moved(self, centroids: NDArray[np.floating]) -> _Tree:
        """The same cells with other centroids."""
        return _Tree(_shortened(np.rint(centroids)).astype(np.float32), self.starts)

    def nearest(self, rows: Array) -> Labels:
        """(N,) indices of the nearest centroid in the nearest cells of each row of integers."""
        spans = list(zip(self.starts[:-1], self.starts[1:], strict=True))
        centres = np.stack([self.centroids[a:b].mean(0, np.float64) for a, b in spans])
        cells = _nearest_few(rows, np.rint(centres).astype(np.float32))
        order = np.argsort(cells, axis=None, kind="stable")
        ends = np.cumsum(np.bincount(cells.ravel(), minlength=len(spans)))
        labels = np.zeros(len(rows), np.int64)
        least = np.full(len(rows), np.inf, np.float32)
        for (first, last), members in zip(spans, np.split(order, ends[:-1]), strict=True):
            inside = members // cells.shape[1]
            found, distances = _nearest(rows[inside], self.centroids[first:last])
            nearer = distances < least[inside]
            least[inside[nearer]] = distances[nearer]
            labels[inside[nearer]] = first + found[nearer]
        return labels


def _train(rows: _Rows, size: int) -> _Tree:
    """``size`` centroids of rows of integers: those of each cell are found from its rows."""
    number = max(1, round(size**0.5))
    some = rows[_spread(len(rows), _ROWS_PER_CELL * number)]
    cells = _lloyd(some, number, _CELL_ROUNDS)
    members = _nearest(rows.values, cells)[0]
    counts = np.bincount(members, minlength=number)
    shares = _shares(counts, size)
    order = np.argsort(members, kind="stable")
    parts = np.split(order, np.cumsum(counts)[:-1])
    centroids = [
        _lloyd(rows[part], int(share), _ROUNDS)
        for part, share in zip(parts, shares, strict=True)
        if share
    ]
    starts = np.concatenate([[0], np.cumsum(shares[shares > 0])])
    return _Tree(np.concatenate(centroids), starts)


def _shares(counts: Labels, size: int) -> Labels:
    """The number of centroids of each cell: in proportion to its rows, ``size`` together, and at
    most as many as rows; ``size`` is smaller than the number of rows."""
    ends = np.cumsum(counts)
    shares: Labels = np.diff(ends * size // ends[-1], prepend=0)
    return shares


def _lloyd(rows: _Rows, size: int, rounds: int) -> Array:
    """``size`` centroids of rows of integers, at first evenly spaced rows."""
    centroids = rows.values[_spread(len(rows), size)]
    for _ in range(rounds):
        means = rows.means(_nearest(rows.values, centroids)[0], centroids)
        centroids = _shortened(np.rint(means)).astype(np.float32)
    return centroids


def _nearest(rows: Array, centroids: Array) -> tuple[Labels, Array]:
    """The index of the nearest centroid (the lowest of ties) of each row, and the squared distance
    to it less the row's squared norm."""
    labels, least = np.empty(len(rows), np.int64), np.empty(len(rows), np.float32)
    for block in _blocks(len(rows)):
        distances = _distances(rows[block], centroids)
        labels[block] = found = distances.argmin(1)
        least[block] = distances[np.arange(len(found)), found]
    return labels, least


def _nearest_few(rows: Array, centres: Array) -> NDArray[np.int32]:
    """(N, ``_NEAREST``) indices of the nearest centres of each row, in no order."""
    count = min(_NEAREST, len(centres))
    found = np.empty((len(rows), count), np.int32)
    for block in _blocks(len(rows)):
        distances = _distances(rows[block], centres)
        found[block] = np.argpartition(distances, count - 1, axis=1)[:, :count]
    return found


def _distances(rows: Array, centroids: Array) -> Array:
    """Squared distances of integers less the rows' squared norms; exact (``_MAX_NORM``)."""
    products: Array = rows @ (-2 * centroids.T)
    products += (centroids * centroids).sum(1)
    return products


def _blocks(count: int) -> list[slice]:
    return [slice(start, start + _BLOCK) for start in range(0, count, _BLOCK)]


def _grid(rows: Array) -> tuple[float, float]:
    """The factor from rows to integers, and the largest norm of a row that is not shortened."""
    squares = np.concatenate([_squares(rows[b : b + _CHUNK]) for b in range(0, len(rows), _CHUNK)])
    longest = float(np.sqrt(min(squares.max(), _OUTLIER**2 * squares.mean())))
    return (_MAX_NORM / longest if longest > 0 else 1.0), longest


def _to_integers(rows: Array, scale: float, longest: float) -> Array:
    norms = np.sqrt(_squares(rows))
    factors = scale * np.minimum(1, longest / np.maximum(norms, 1e-30))
    return np.rint(rows * factors[:, None]).astype(np.float32)


def _shortened(rows: NDArray[np.floating]) -> NDArray[np.floating]:
    """Rows whose norm is at most that of the integers, rounded towards zero where it was not."""
    norms = np.sqrt(_squares(rows))
    longer = norms > _MAX_NORM
    if longer.any():
        rows[longer] = np.trunc(rows[longer] * (_MAX_NORM / norms[longer])[:, None])
    return rows


def _squares(rows: NDArray[np.floating]) -> NDArray[np.float64]:
    found: NDArray[np.float64] = np.square(rows, dtype=np.float64).sum(1)
    return found


def _spread(number: int, count: int) -> Labels:
    """Up to ``count`` evenly spaced indices of ``number`` rows."""
    count = min(count, number)
    return np.arange(count) * number // max(count, 1)
