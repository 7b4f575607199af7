"""The user's depth maps, scaled to the scene and sampled.

A sensor's depths are known up to a factor (for example millimetres); a network's up to factor and
shift, of the depth or, more often, of its inverse. Each map is fitted to the view's sparse points
in these three ways; the best fit is used, the simplest of about equal ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.photos.load import load_depth
from pipeline.scene.views import View
from pipeline.training.data.known_depths import KnownDepths

#: Samples per view: dense enough for walls, somewhat more than the sparse points of most views.
SAMPLES = 3000
#: With fewer points a map is not used.
MIN_POINTS = 12
#: A map with a larger median error of the logarithm at the points is not used.
MAX_ERROR = 0.1
#: A fit with more parameters replaces a simpler one only if its error is below this share of the
#: other's, and only if the other's is above GOOD, the accuracy of points and pixels.
BETTER, GOOD = 0.8, 0.03
#: Pixels that differ from a neighbour by more than this share are at an edge and not sampled.
EDGE = 0.05
#: Pairs of points whose lines are tried.
PAIRS = 300

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fit:
    """Camera z as a function of a map's values v.

    Attributes:
        kind: "factor": z = a v; "depth": z = a v + b; "inverse": 1 / z = a v + b.
        error: The median of |log(z / known z)| over the points.
    """

    kind: str
    a: float
    b: float
    error: float

    def depth(self, values: Array) -> Array:
        """Camera z of map values; NaN outside the range of the fit."""
        line = self.a * values + self.b
        with np.errstate(divide="ignore", invalid="ignore"):
            z = 1.0 / line if self.kind == "inverse" else line
        return np.where(line > 0, z, np.nan)


def fit_map(values: Array, z: Array) -> Fit | None:
    """The fit of a map's ``values`` (M,) at points to their depths ``z`` (M,), or None."""
    usable = np.isfinite(values) & (values > 0)
    values, z = values[usable], z[usable]
    if len(z) < MIN_POINTS:
        return None
    best: Fit | None = None
    for kind in ("factor", "depth", "inverse"):
        a, b = _solve(kind, values, z)
        fit = Fit(kind, a, b, 0.0)
        off = np.abs(np.log(fit.depth(values) / z))
        # Values without a depth count as infinitely wrong.
        fit = Fit(kind, a, b, float(np.median(np.where(np.isfinite(off), off, np.inf))))
        if best is None or (best.error > GOOD and fit.error < BETTER * best.error):
            best = fit
    return best if best is not None and best.error <= MAX_ERROR else None


def map_depths(
    view: View, path: str, points: KnownDepths, digest: str | None = None
) -> tuple[KnownDepths, Fit] | tuple[None, None]:
    """Samples of the depth map ``path`` of ``view``, fitted to the depths of its ``points``.

    Args:
        digest: The file's recorded digest.

    Returns:
        The samples, each of weight 1, and the fit; None if the map does not fit the points.

    Raises:
        UserError: The file is not a readable depth map, or has another aspect ratio.
    """
    full = load_depth(path, view.width / view.height, digest)
    height, width = full.shape

    def at(xy: Array) -> Array:
        column = (xy[:, 0] * (width / view.width)).astype(int).clip(0, width - 1)
        row = (xy[:, 1] * (height / view.height)).astype(int).clip(0, height - 1)
        return full[row, column]

    fit = fit_map(at(points.xy), points.z.astype(np.float64))
    if fit is None:
        return None, None
    step = max(1.0, np.sqrt(view.width * view.height / SAMPLES))
    x, y = np.meshgrid(
        np.arange(step / 2, view.width, step), np.arange(step / 2, view.height, step)
    )
    xy = np.stack([x.ravel(), y.ravel()], 1)
    values = at(xy)
    around = np.stack([at(xy + offset) for offset in ((1, 0), (-1, 0), (0, 1), (0, -1))])
    with np.errstate(invalid="ignore"):
        smooth = (np.abs(around - values) < EDGE * values).all(0)
        z = fit.depth(values)
        usable = smooth & np.isfinite(z) & (values > 0)
    ones = np.ones(int(usable.sum()), np.float32)
    return KnownDepths(xy[usable], z[usable].astype(np.float32), ones), fit


def merged(points: KnownDepths, samples: KnownDepths) -> KnownDepths:
    """Both sets, with their own weights."""
    return KnownDepths(
        np.concatenate([points.xy, samples.xy]),
        np.concatenate([points.z, samples.z]),
        np.concatenate([points.weight, samples.weight]),
    )


def add_maps(
    views: Sequence[View],
    points: Sequence[KnownDepths],
    maps: Sequence[tuple[str, str | None] | None],
    fitted_to: Sequence[KnownDepths],
) -> tuple[list[KnownDepths], dict[str, int], list[str]]:
    """``points`` with the samples of the views' depth maps.

    Args:
        maps: Each view's file and its recorded digest; None for a view without a depth map.
        fitted_to: The depths that maps are fitted to: ``points``, or others if there are none.

    Returns:
        The known depths by view; the number of maps by kind of fit; the names of views whose maps
        do not fit.
    """
    known, kinds, refused = list(points), dict.fromkeys(("factor", "depth", "inverse"), 0), []
    for index, (view, file) in enumerate(zip(views, maps, strict=True)):
        if file is None:
            continue
        path, digest = file
        samples, fit = map_depths(view, path, fitted_to[index], digest)
        if samples is None or fit is None:
            refused.append(view.name)
            continue
        kinds[fit.kind] += 1
        known[index] = merged(points[index], samples)
    return known, {kind: count for kind, count in kinds.items() if count}, refused


def _solve(kind: str, values: Array, z: Array) -> tuple[float, float]:
    """a and b of the line through two points with the least median error, refined by least squares
    of relative errors over its inliers."""
    if kind == "factor":
        return float(np.exp(np.median(np.log(z / values)))), 0.0
    target = 1.0 / z if kind == "inverse" else z
    first, second = np.random.Generator(np.random.PCG64(0)).integers(len(z), size=(2, PAIRS))
    apart = values[first] != values[second]
    if not apart.any():
        return 0.0, 0.0
    first, second = first[apart], second[apart]
    a = (target[first] - target[second]) / (values[first] - values[second])
    b = target[first] - a * values[first]
    off = np.abs((a[:, None] * values + b[:, None]) / target - 1.0)
    median = np.median(off, axis=1)
    best = int(median.argmin())
    inlier = off[best] <= max(3 * float(median[best]), 1e-9)
    # The normal equations in plain sums: BLAS may round differently with the number of threads.
    u, w = values[inlier] / target[inlier], 1.0 / target[inlier]
    uu, uw, ww, u1, w1 = (float(term.sum()) for term in (u * u, u * w, w * w, u, w))
    scale = uu * ww - uw * uw
    if scale <= 0:
        return float(a[best]), float(b[best])
    return (ww * u1 - uw * w1) / scale, (uu * w1 - uw * u1) / scale
