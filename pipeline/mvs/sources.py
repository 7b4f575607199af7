"""Selection of the source views that each reference view is matched with.

The score of a pair is a sum over the sparse points that both views see, with a weight for the
triangulation angle and one for the ratio of resolutions (Goesele et al. 2007; the weight of the
angle as in Yao et al. 2018).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View

# The best triangulation angle, and the standard deviations of the weight below and above it,
# degrees: small angles determine depth poorly, at large ones windows look different.
BEST_ANGLE, BELOW, ABOVE = 10.0, 4.0, 12.0
# Points with a smaller angle do not count, degrees: views from one position, such as those of a
# panorama, match at any depth.
MIN_ANGLE = 1.0
# Weight of a point that so many chosen sources see: two are enough.
COVERED = np.array([1.0, 1.0, 0.5, 0.25, 0.1])
# Pairs that share fewer points are not matched.
MIN_SHARED = 8
# Without shared points: largest angle between the viewing directions, degrees.
MAX_TURN = 45.0


def select_sources(
    views: Sequence[View], model: Reconstruction, count: int
) -> list[NDArray[np.intp]]:
    """At most ``count`` sources of each view, best first, as indices into ``views``.

    A view that shares too few sparse points with every other one gets the nearest views with a
    similar direction. A view alone gets none.
    """
    pairs = _Observations(views, model)
    result = []
    for index in range(len(views)):
        found = pairs.sources_of(index, count)
        result.append(found if len(found) else _nearest(views, index, count))
    return result


def seen_points(views: Sequence[View], model: Reconstruction) -> list[NDArray[np.intp]]:
    """Indices of the sparse points whose tracks contain each view, ascending."""
    return [np.unique(points) for points in model.observed_points(view.name for view in views)]


class _Observations:
    """The sparse points that views see, for the scores of pairs."""

    def __init__(self, views: Sequence[View], model: Reconstruction):
        self._xyz = model.points.xyz
        self._seen = seen_points(views, model)
        observer = np.repeat(np.arange(len(views)), [len(points) for points in self._seen])
        observed = np.concatenate([*self._seen, np.zeros(0, np.intp)])
        order = np.argsort(observed, kind="stable")
        self._observer, self._observed = observer[order], observed[order]
        self._start = np.searchsorted(self._observed, np.arange(len(self._xyz) + 1))
        self._centres = np.stack([view.centre for view in views]) if views else np.zeros((0, 3))
        self._focal = np.array([np.sqrt(view.fx * view.fy) for view in views])

    def sources_of(self, index: int, count: int) -> NDArray[np.intp]:
        """The best sources, chosen one after the other: points that chosen sources see already
        count less, so that sources cover the whole view."""
        points, number = self._seen[index], len(self._centres)
        rows = _ranges(self._start[points], self._start[points + 1])
        other, point = self._observer[rows], self._observed[rows]
        usable = np.bincount(other, minlength=number) >= MIN_SHARED
        usable[index] = False
        rows = np.flatnonzero(usable[other])
        other, point = other[rows], point[rows]
        weight = self._weight(index, other, point)
        place = np.searchsorted(points, point)
        covered = np.zeros(len(points), np.intp)
        chosen: list[int] = []
        for _ in range(count):
            gain = np.bincount(other, weight * COVERED[covered[place]], number)
            gain[chosen] = 0.0
            if not len(gain) or not (best := int(gain.argmax())) >= 0 or gain[best] <= 0:
                break
            chosen.append(best)
            covered[place[other == best]] += 1
            np.minimum(covered, len(COVERED) - 1, out=covered)
        return np.array(chosen, np.intp)

    def _weight(
        self, index: int, other: NDArray[np.intp], point: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """Weight of each point in another view for the view ``index``, in [0, 1]."""
        own = self._xyz[point] - self._centres[index]
        ray = self._xyz[point] - self._centres[other]
        near = np.maximum(np.linalg.norm(own, axis=1), 1e-300)
        far = np.maximum(np.linalg.norm(ray, axis=1), 1e-300)
        angle = np.degrees(np.arccos(np.clip((own * ray).sum(1) / (near * far), -1.0, 1.0)))
        spread = np.where(angle < BEST_ANGLE, BELOW, ABOVE)
        weight = np.exp(-0.5 * ((angle - BEST_ANGLE) / spread) ** 2)
        weight[angle < MIN_ANGLE] = 0.0
        ratio = self._focal[other] * near / (self._focal[index] * far)
        return np.asarray(weight * np.minimum(ratio, 1.0 / ratio))


def _ranges(start: NDArray[np.intp], stop: NDArray[np.intp]) -> NDArray[np.intp]:
    """The concatenation of the ranges."""
    length = stop - start
    first = np.repeat(start - np.concatenate([[0], np.cumsum(length)[:-1]]), length)
    return np.asarray(first + np.arange(int(length.sum())), np.intp)


def _nearest(views: Sequence[View], index: int, count: int) -> NDArray[np.intp]:
    """The nearest views at another position whose direction differs by less than ``MAX_TURN``."""
    centres = np.stack([view.centre for view in views])
    axes = np.stack([view.world_to_camera[2, :3] for view in views])
    distance = np.linalg.norm(centres - centres[index], axis=1)
    usable = axes @ axes[index] > np.cos(np.radians(MAX_TURN))
    usable &= distance > 1e-6 * max(float(distance.max()), 1e-300)
    order = np.argsort(distance, kind="stable")
    return np.asarray(order[usable[order]][:count], np.intp)
