"""Relative exposure and white balance of photographs, from their colours at the sparse points.

The colours that different photographs record of one point differ by exposure and white balance. In
display values, which follow a power law of light, both are one factor per channel. With y_pv the
logarithm of the value of point p in view v, the model is y_pv = c_p + g_v. It is solved by
alternating means over points and medians over views; the geometric mean of the gains is 1.
``photos.shading`` adds factors that vary over the image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.photos.load import load_view
from pipeline.scene.exposure import half_diagonal
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View, evenly_spaced

#: Stops per unit of log2 in display values: the sRGB curve is close to a power of 1 / 2.2.
GAMMA = 2.2
#: The range of usable display values: darker and brighter ones are clipped or noisy.
DARK, BRIGHT = 0.04, 0.96
#: Views with fewer usable observations keep a gain of 1.
MIN_OBSERVATIONS = 20
#: The number of views that are measured.
SAMPLE = 64
#: The number of alternations of the solver.
ROUNDS = 20
NO_LENSES: Mapping[str, str] = {}

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Exposures:
    """The gains of views.

    Attributes:
        gains: (V, 3) float64 RGB factors of a view's display values relative to the average view.
        spread: The standard deviation of the gains over the views in stops; the largest of the
            channels.
        measured: The number of photographs with at least ``MIN_OBSERVATIONS`` usable observations.
    """

    gains: Array
    spread: float
    measured: int


@dataclass(frozen=True)
class Observations:
    """The colours of points in photographs, M observations.

    Attributes:
        point: (M,) the point of each observation, a row of ``Reconstruction.points``.
        view: (M,) its view.
        position: (M, 2) its place in the image, as in ``scene.exposure.ViewLight``.
        y: (M, 3) log2 of its display values.
        photo_of: (V,) the photograph of each view: views of one photograph share a gain.
        camera_of: (V,) the camera of each view, counted from 0.
        in_parts: Whether views are parts of photographs, without a lens of their own.
    """

    point: Indices
    view: Indices
    position: Array
    y: Array
    photo_of: Indices
    camera_of: Indices
    in_parts: bool

    @property
    def photo(self) -> Indices:
        """(M,) the photograph of each observation."""
        return self.photo_of[self.view]

    @property
    def camera(self) -> Indices:
        """(M,) the camera of each observation."""
        return self.camera_of[self.view]

    @property
    def num_photos(self) -> int:
        return int(self.photo_of.max(initial=-1)) + 1

    @property
    def num_cameras(self) -> int:
        return int(self.camera_of.max(initial=-1)) + 1

    def select(self, chosen: NDArray[np.bool_]) -> Observations:
        """Those of the observations that are ``chosen`` (M,), without points that have only one
        of them; points are numbered again."""
        _, index, count = np.unique(self.point[chosen], return_inverse=True, return_counts=True)
        several = count[index] >= 2
        _, point = np.unique(index[several], return_inverse=True)
        rows = np.flatnonzero(chosen)[several]
        return replace(
            self,
            point=point,
            view=self.view[rows],
            position=self.position[rows],
            y=self.y[rows],
        )


def observe(
    views: Sequence[View], model: Reconstruction, lenses: Mapping[str, str] = NO_LENSES
) -> Observations:
    """The colours of ``views`` at the observations of ``model``.

    Args:
        views: The views of images of ``model``, matched by name. They may have another resolution
            than the model's cameras.
        lenses: The camera group of each photograph by name, which tells cameras apart that share
            the intrinsics of ``model``; empty if unknown.
    """
    points = model.points
    owner = np.repeat(np.arange(len(points)), points.track_length)
    numbers = {image.name: number for number, image in model.images.items()}
    groups: dict[str, int] = {}
    photos = [groups.setdefault(view.source or view.name, len(groups)) for view in views]
    cameras: dict[tuple[int, str], int] = {}
    keys = [(view.camera_id, lenses.get(view.name, "")) for view in views]
    bodies = [cameras.setdefault(key, len(cameras)) for key in keys]
    point_of, view_of, positions = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], []
    colours = [np.zeros((0, 3))]
    positions.append(np.zeros((0, 2)))
    for index, view in enumerate(views):
        number = numbers[view.name]
        observations = np.flatnonzero(points.track_image_id == number)
        if not len(observations):
            continue
        camera = model.cameras[model.images[number].camera_id]
        scale = np.array([view.width / camera.width, view.height / camera.height])
        xy = points.track_xy[observations] * scale
        usable, log_colours = _log_colours(view, xy)
        point_of.append(owner[observations[usable]])
        view_of.append(np.full(len(log_colours), index))
        positions.append((xy[usable] - (view.cx, view.cy)) / half_diagonal(view))
        colours.append(log_colours)
    return Observations(
        np.concatenate(point_of),
        np.concatenate(view_of),
        np.concatenate(positions),
        np.concatenate(colours),
        np.array(photos, np.int64),
        np.array(bodies, np.int64),
        any(view.source is not None for view in views),
    )


def sample_views(views: Sequence[View]) -> list[View]:
    """Up to ``SAMPLE`` views, evenly spaced."""
    return evenly_spaced(views, SAMPLE)


def _log_colours(view: View, xy: Array) -> tuple[NDArray[np.bool_], Array]:
    """(M,) whether each of the pixels ``xy`` (M, 2) is usable, and (K, 3) log2 of the display
    values of those."""
    pixels = load_view(view)
    usable = np.isfinite(xy).all(axis=1)
    column, row = np.nan_to_num(xy).astype(int).T
    column, row = column.clip(0, view.width - 1), row.clip(0, view.height - 1)
    colours = pixels.rgb[row, column] / 255.0
    usable &= ((colours > DARK) & (colours < BRIGHT)).all(axis=1)
    if pixels.mask is not None:
        usable &= pixels.mask[row, column]
    return usable, np.log2(colours[usable])


def solve_gains(
    point: Indices,
    view: Indices,
    y: Array,
    count: int,
    *,
    start: Array | None = None,
    rounds: int = ROUNDS,
) -> Exposures:
    """Solve for the gains of views.

    Args:
        point, view: (M,) indices of the point and the view of each observation.
        y: (M, 3) log2 display values.
        count: The number of views.
        start: (count, 3) log2 of the gains to start from; None: 0.
        rounds: The number of alternations.
    """
    _, point = np.unique(point, return_inverse=True)
    observed = np.bincount(point)
    several = observed[point] >= 2
    point, view, y = point[several], view[several], y[several]
    members = [np.flatnonzero(view == v) for v in range(count)]
    weight = np.maximum(np.bincount(point, minlength=len(observed)), 1)
    measured = np.array([len(m) >= MIN_OBSERVATIONS for m in members])
    gains = np.zeros((count, 3)) if start is None else start.copy()
    if not measured.any():
        return Exposures(np.ones((count, 3)), 0.0, 0)
    for _ in range(rounds):
        normalized = y - gains[view]
        sums = [np.bincount(point, normalized[:, c], len(observed)) for c in range(3)]
        colour = np.stack(sums, axis=1)
        residual = y - (colour / weight[:, None])[point]
        for v in np.flatnonzero(measured):
            gains[v] = np.median(residual[members[v]], axis=0)
        gains[measured] -= gains[measured].mean(axis=0)
    spread = float(gains[measured].std(axis=0).max() * GAMMA)
    return Exposures(2.0**gains, spread, int(measured.sum()))
