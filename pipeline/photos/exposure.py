"""How bright photographs are against one another, from what they show at the sparse points.

A point of the scene that several photographs see has one colour; what they record of it differs
by each photograph's exposure and white balance. In display values, which go with light by a power
law, both are a factor a channel. With y_op the logarithm of the value that observation o of point
p has in view v, the model is y = c_p + g_v, solved by alternating robust means; the factors'
geometric mean over the views is 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.photos.load import load_view
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View

#: Stops a unit of log2 in display values: sRGB's curve is near a power of 1 / 2.2.
GAMMA = 2.2
#: Display values nearer to black or white than this say nothing about exposure.
DARK, BRIGHT = 0.04, 0.96
#: Views with fewer usable observations keep a gain of 1.
MIN_OBSERVATIONS = 20
#: Enough views to tell whether photographs differ.
SAMPLE = 64
ROUNDS = 20

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Exposures:
    """Gains by view.

    Attributes:
        gains: (V, 3) float64: what display values of the typical photograph are multiplied by to
            give this view's, for red, green and blue.
        spread: standard deviation over the views in stops, of the channel that varies most.
        measured: views with observations enough.
    """

    gains: Array
    spread: float
    measured: int


def measure_exposures(views: Sequence[View], model: Reconstruction) -> Exposures:
    """Gains of ``views`` from the colours at the points of ``model`` that they see.

    Args:
        views: with images of ``model`` by name; the model's observations in pixels of its cameras.
    """
    points = model.points
    owner = np.repeat(np.arange(len(points)), points.track_length)
    numbers = {image.name: number for number, image in model.images.items()}
    rows, levels, view_of = [], [], []
    for index, view in enumerate(views):
        number = numbers[view.name]
        here = np.flatnonzero(points.track_image_id == number)
        if not len(here):
            continue
        camera = model.cameras[model.images[number].camera_id]
        scale = np.array([view.width / camera.width, view.height / camera.height])
        found, level = _log_colours(view, points.track_xy[here] * scale)
        rows.append(owner[here[found]])
        levels.append(level)
        view_of.append(np.full(len(level), index))
    if not rows:
        return Exposures(np.ones((len(views), 3)), 0.0, 0)
    return _solve(np.concatenate(rows), np.concatenate(view_of), np.concatenate(levels), len(views))


def sample_views(views: Sequence[View]) -> list[View]:
    """Up to ``SAMPLE`` of the views, evenly spread."""
    picks = np.linspace(0, len(views) - 1, min(SAMPLE, len(views))).round().astype(int)
    return [views[i] for i in picks]


def _log_colours(view: View, xy: Array) -> tuple[NDArray[np.bool_], Array]:
    """Which of the pixels ``xy`` (M, 2) are usable, and log2 of their display values (K, 3)."""
    pixels = load_view(view)
    usable = np.isfinite(xy).all(axis=1)
    column, row = np.nan_to_num(xy).astype(int).T
    column, row = column.clip(0, view.width - 1), row.clip(0, view.height - 1)
    colours = pixels.rgb[row, column] / 255.0
    usable &= ((colours > DARK) & (colours < BRIGHT)).all(axis=1)
    if pixels.mask is not None:
        usable &= pixels.mask[row, column]
    return usable, np.log2(colours[usable])


def _solve(point: NDArray[np.int64], view: NDArray[np.int64], y: Array, count: int) -> Exposures:
    """``point``, ``view`` (M,) and ``y`` (M, 3) of every observation."""
    _, point = np.unique(point, return_inverse=True)
    seen = np.bincount(point)
    several = seen[point] >= 2
    point, view, y = point[several], view[several], y[several]
    members = [np.flatnonzero(view == v) for v in range(count)]
    weight = np.maximum(np.bincount(point, minlength=len(seen)), 1)
    measured = np.array([len(m) >= MIN_OBSERVATIONS for m in members])
    gains = np.zeros((count, 3))
    if not measured.any():
        return Exposures(np.ones((count, 3)), 0.0, 0)
    for _ in range(ROUNDS):
        own = y - gains[view]
        colour = np.stack([np.bincount(point, own[:, c], len(seen)) for c in range(3)], axis=1)
        residual = y - (colour / weight[:, None])[point]
        for v in np.flatnonzero(measured):
            gains[v] = np.median(residual[members[v]], axis=0)
        gains[measured] -= gains[measured].mean(axis=0)
    spread = float(gains[measured].std(axis=0).max() * GAMMA)
    return Exposures(2.0**gains, spread, int(measured.sum()))
