"""The disagreement of photographs on the colours of the same points, apart from exposure.

Photographs of one scene in one light agree except for noise, highlights and inaccurate points. In
photographs of another time of day, weather or processing, colours differ from point to point.

Photographs in very different light have few matches, so that tracks hardly connect them. Points
that one of several photographs from the same place observes are therefore observed by all of them:
nothing occludes a point in one of these photographs alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.photos.exposure import BRIGHT, DARK, MIN_OBSERVATIONS, sample_views, solve_gains
from pipeline.photos.load import load_view
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View

# Photographs are from the same place if the distance of their centres is at most this share of the
# depth of the nearest tenth of what they see, and their viewing directions differ by less than this
# angle: features then move by a few pixels.
SAME_PLACE, SAME_DIRECTION = 0.005, np.radians(3.0)
# Colours are means over squares of this side in pixels: points are not more accurate.
WINDOW = 5
# The ratio of the standard deviation to the median absolute value of a normal distribution.
TO_DEVIATION = 1.4826

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ObservedColours:
    """Colours of points in photographs.

    Attributes:
        point, view: (M,) indices of the point and the view of each observation.
        colours: (M, 3) log2 of the colours.
    """

    point: NDArray[np.int64]
    view: NDArray[np.int64]
    colours: Array


@dataclass(frozen=True)
class ColourDisagreement:
    """How far photographs disagree on colours.

    Attributes:
        value: The robust standard deviation of log2 of the colours of a point over the photographs,
            after gains that compensate exposure and white balance; the median over the measured
            views, 0 without any.
        measured: The share of a sample of the views that see enough points which other views see.
    """

    value: float
    measured: float


def colour_disagreement(
    views: Sequence[View], model: Reconstruction, points: Array
) -> ColourDisagreement:
    """Measure the disagreement on a sample of the views.

    Args:
        views: The views of images of ``model``, matched by name.
        points: The (N, 3) points of the scene, for a model without points.
    """
    views = sample_views(views)
    found = observed_colours(views, model, points)
    if not len(found.point):
        return ColourDisagreement(0.0, 0.0)
    return _spread(found.point, found.view, found.colours, len(views))


def observed_colours(
    views: Sequence[View], model: Reconstruction, points: Array
) -> ObservedColours:
    """The colours of points in the views that observe them.

    Args:
        views, points: See ``colour_disagreement``.
    """
    tracked = len(model.points) > 0
    means = np.asarray(model.points.xyz if tracked else points, np.float64)
    observed = _tracks(views, model) if tracked else None
    projected = [_project(view, means) for view in views]
    if observed is None:
        observed = [
            np.flatnonzero(_inside(view, p)) for view, p in zip(views, projected, strict=True)
        ]
    depths = [
        float(np.quantile(p[o, 2], 0.1)) if len(o) else 0.0
        for p, o in zip(projected, observed, strict=True)
    ]
    point, view_index, colours = [], [], []
    for index, (view, place) in enumerate(zip(views, _same_places(views, depths), strict=True)):
        if not tracked and len(place) == 1:
            continue  # It is unknown what hides a point from one of two places.
        rows = np.unique(np.concatenate([observed[other] for other in place]))
        rows = rows[_inside(view, projected[index][rows])]
        usable, values = _log_colours(view, projected[index][rows])
        point.append(rows[usable])
        view_index.append(np.full(len(values), index))
        colours.append(values)
    if not point:
        nothing = np.zeros(0, np.int64)
        return ObservedColours(nothing, nothing, np.zeros((0, 3)))
    return ObservedColours(
        np.concatenate(point), np.concatenate(view_index), np.concatenate(colours)
    )


def _spread(
    point: NDArray[np.int64], view: NDArray[np.int64], y: Array, count: int
) -> ColourDisagreement:
    """The disagreement; the arguments are those of ``solve_gains``."""
    _, point, observed = np.unique(point, return_inverse=True, return_counts=True)
    several = observed[point] >= 2
    point, view, y = point[several], view[several], y[several]
    if not len(point):
        return ColourDisagreement(0.0, 0.0)
    y = y - np.log2(solve_gains(point, view, y, count).gains)[view]
    _, point, observed = np.unique(point, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(point, y[:, c]) for c in range(3)], axis=1) / observed[:, None]
    # The mean of n values is closer to each of them than the truth, by sqrt((n - 1) / n).
    residual = (y - means[point]) * np.sqrt(observed / (observed - 1.0))[point][:, None]
    of_views = [residual[view == v] for v in range(count)]
    found = [np.median(np.abs(r)) for r in of_views if len(r) >= MIN_OBSERVATIONS]
    value = float(np.median(found)) * TO_DEVIATION if found else 0.0
    return ColourDisagreement(value, len(found) / count)


def _tracks(views: Sequence[View], model: Reconstruction) -> list[NDArray[np.int64]]:
    """The rows of the points that each view observes."""
    points = model.points
    owner = np.repeat(np.arange(len(points)), points.track_length)
    numbers = {image.name: number for number, image in model.images.items()}
    return [np.unique(owner[points.track_image_id == numbers[view.name]]) for view in views]


def _same_places(views: Sequence[View], depths: Sequence[float]) -> list[list[int]]:
    """For each view, the views from the same place, including itself."""
    centres = np.array([view.centre for view in views])
    axes = np.array([view.world_to_camera[2, :3] for view in views])
    result = []
    for centre, axis, depth in zip(centres, axes, depths, strict=True):
        near = np.linalg.norm(centres - centre, axis=1) <= SAME_PLACE * depth
        ahead = (axes * axis).sum(1) > np.cos(SAME_DIRECTION)
        result.append(np.flatnonzero(near & ahead).tolist())
    return result


def _project(view: View, points: Array) -> Array:
    """(N, 3) pixel coordinates and depths of points."""
    pose = view.world_to_camera
    x, y, z = np.einsum("ij,nj->in", pose[:3, :3], points) + pose[:3, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([view.fx * x / z + view.cx, view.fy * y / z + view.cy, z], axis=1)


def _inside(view: View, projected: Array) -> NDArray[np.bool_]:
    """(N,) whether each point is in the image."""
    x, y, z = projected.T
    with np.errstate(invalid="ignore"):
        return (z > 0) & (x >= 0) & (y >= 0) & (x < view.width) & (y < view.height)


def _log_colours(view: View, projected: Array) -> tuple[NDArray[np.bool_], Array]:
    """(M,) whether each of the points (M, 3) is usable, and (K, 3) log2 of the colours of those."""
    pixels = load_view(view)
    column, row = projected[:, 0].astype(int), projected[:, 1].astype(int)
    colours = cv2.blur(pixels.rgb, (WINDOW, WINDOW))[row, column] / 255.0
    usable = ((colours > DARK) & (colours < BRIGHT)).all(axis=1)
    if pixels.mask is not None:
        usable &= pixels.mask[row, column]
    return usable, np.log2(colours[usable])
