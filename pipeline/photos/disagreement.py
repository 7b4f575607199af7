"""The disagreement of photographs on the colours of the same points, apart from exposure.

Photographs of one scene in one light agree except for noise, highlights and inaccurate points. In
photographs of another time of day, weather or processing, colours differ from point to point.
Neighbours are compared: between views from far apart, highlights move, and points that are not
quite on the surface have other colours.

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

from pipeline.photos.exposure import BRIGHT, DARK, MIN_OBSERVATIONS, sample_views
from pipeline.photos.load import load_view
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View

# Photographs are from the same place if the distance of their centres is at most this share of the
# depth of the nearest tenth of what they see, and their viewing directions differ by less than this
# angle: features then move by a few pixels.
SAME_PLACE, SAME_DIRECTION = 0.005, np.radians(3.0)
# A view is compared with so many others that have enough points in common, the nearest first: by
# the distance of the centres as a share of the depth, and the angle between the viewing directions.
NEIGHBOURS = 4
# Colours are means over squares of this share of the longer side, so that they do not depend on the
# resolution, and of at least so many pixels: points are not more accurate.
WINDOW, MIN_WINDOW = 1 / 64, 5
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
        value: The robust standard deviation of log2 of the colours of a point over a view and its
            ``NEIGHBOURS``, apart from exposure and white balance; the median over the measured
            views, 0 without any.
        measured: The share of a sample of the views that see enough points which another view sees.
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
    tracked = len(model.points) > 0
    return _compare(found, views, np.asarray(model.points.xyz if tracked else points, np.float64))


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


def _compare(found: ObservedColours, views: Sequence[View], means: Array) -> ColourDisagreement:
    """The disagreement of views with their neighbours.

    Args:
        means: (N, 3) the positions of the points.
    """
    rows = [np.flatnonzero(found.view == index) for index in range(len(views))]
    centres = np.array([view.centre for view in views])
    axes = np.array([view.world_to_camera[2, :3] for view in views])
    values = []
    for index, own in enumerate(rows):
        if len(own) < MIN_OBSERVATIONS:
            continue
        depth = np.median(np.linalg.norm(means[found.point[own]] - centres[index], axis=1))
        angles = np.arccos((axes * axes[index]).sum(1).clip(-1, 1))
        distances = np.linalg.norm(centres - centres[index], axis=1) / max(depth, 1e-12) + angles
        differences = []
        for other in np.argsort(distances, kind="stable"):
            if other != index and (of_pair := _difference(found, own, rows[other])) is not None:
                differences.append(of_pair)
            if len(differences) == NEIGHBOURS:
                break
        if differences:
            values.append(float(np.sqrt(np.mean(np.square(differences)))))
    return ColourDisagreement(float(np.median(values)) if values else 0.0, len(values) / len(views))


def _difference(
    found: ObservedColours, one: NDArray[np.int64], other: NDArray[np.int64]
) -> float | None:
    """How far two views, of which these are the observations, disagree; None without enough common
    points."""
    common, i, j = np.intersect1d(found.point[one], found.point[other], return_indices=True)
    if len(common) < MIN_OBSERVATIONS:
        return None
    change = found.colours[one[i]] - found.colours[other[j]]
    # The same exposure and white balance; the variance of a difference is that of both views.
    change = change - np.median(change, axis=0)
    return float(np.median(np.abs(change))) * TO_DEVIATION / np.sqrt(2)


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
    side = max(MIN_WINDOW, round(WINDOW * max(view.width, view.height)))
    colours = cv2.blur(pixels.rgb, (side, side))[row, column] / 255.0
    usable = ((colours > DARK) & (colours < BRIGHT)).all(axis=1)
    if pixels.mask is not None:
        usable &= pixels.mask[row, column]
    return usable, np.log2(colours[usable])
