"""What a novel view shows although the photographs contradict it: floaters, veils and haze.

A pixel of a novel view is contradicted if

- it shows a surface that fewer than two training views see, and that two of them see past, or that
  is nearer than half the distance of the nearest surface in view on which two agree (a floater); or
- it shows a surface that training views see, in a colour that none of their photographs has there
  (a veil or haze, which is too transparent to be the surface itself).

A pixel whose surface no training view sees is unseen: nothing is known of what belongs there.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.coverage.defects import MIN_AGREEING, NEAR_SHARE
from pipeline.coverage.probe_views import (
    Bools,
    Doubles,
    Floats,
    ProbeView,
    QueryPoints,
    backproject,
    find_visible,
    neighbourhood,
    project,
)
from pipeline.coverage.training_views import TrainingViews
from pipeline.photos.load import load_view, resize_area
from pipeline.render import Color
from pipeline.scene.views import View

#: Number of photographs, those that see most of a novel view, whose colours are compared.
MAX_PHOTOGRAPHS = 4
#: Difference of colours in [0, 1], in the channel that differs most, that contradicts a photograph.
MIN_DIFFERENCE = 0.1
#: Bounds of the gain by which a photograph is multiplied to match its render's exposure.
GAINS = 0.5, 2.0
CONTRADICTED_COLOUR, UNSEEN_COLOUR = (255, 150, 0), (45, 65, 140)


@dataclass(frozen=True)
class Contradictions:
    """The judged pixels of a novel view, every ``step``-th in both directions.

    Attributes:
        contradicted: (H, W) pixels that contradict the photographs.
        unseen: (H, W) other pixels, whose surface no training view sees.
    """

    contradicted: Bools
    unseen: Bools


class ColourRange(NamedTuple):
    """The range of a photograph's colours in the 3 x 3 neighbourhood of each pixel of its probe
    view, (H * W, 3) in [0, 1], at the exposure of the render."""

    low: Floats
    high: Floats


@dataclass(frozen=True)
class _Evidence:
    """How the training views see the points of a novel view.

    Attributes:
        count, seen_past: (N,) see ``Observations``.
        photographs: Indices of the training views that see most of the points, at most
            ``MAX_PHOTOGRAPHS``.
    """

    points: QueryPoints
    count: NDArray[np.intp]
    seen_past: NDArray[np.intp]
    photographs: Sequence[int]


def find_contradictions(
    shown: Sequence[ProbeView],
    training: TrainingViews,
    background: Color,
    threads: int,
    step: int = 1,
) -> list[Contradictions]:
    """Compare novel views with the training views and their photographs.

    Args:
        shown: The novel views.
        background: The colour behind photographs with an alpha channel.
        threads: The number of views at a time, which does not affect results.
        step: The stride of the compared pixels.
    """
    agreed = training.surface.agreed(MIN_AGREEING)
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        found = list(pool.map(lambda probe: _evidence(probe, training, step), shown))
        needed = sorted({i for evidence in found for i in evidence.photographs})
        ranges = pool.map(
            lambda i: _colour_range(training.views[i], training.probes[i], background), needed
        )
        colours = dict(zip(needed, ranges, strict=True))

        def judge(probe: ProbeView, evidence: _Evidence) -> Contradictions:
            return _judge(probe, evidence, training, agreed, colours, step)

        return list(pool.map(judge, shown, found))


def contradiction_map(probe: ProbeView, found: Contradictions) -> NDArray[np.uint8]:
    """(H, W, 3) the render, dimmed, with contradicted pixels orange and unseen ones blue.

    Args:
        found: The contradictions of the probe view with a stride of 1.
    """
    picture = probe.rgb // 3
    picture[found.unseen] = UNSEEN_COLOUR
    picture[found.contradicted] = CONTRADICTED_COLOUR
    return picture


def _evidence(probe: ProbeView, training: TrainingViews, step: int) -> _Evidence:
    points = backproject(probe, training.background_depth, step)
    count, seen_past = np.zeros((2, len(points)), np.intp)
    overlap = []
    for photograph in training.probes:
        visibility = find_visible(photograph, points.xyz, points.empty)
        count[visibility.visible] += 1
        seen_past += visibility.seen_past
        overlap.append(len(visibility.visible))
    most = np.argsort(-np.array(overlap), kind="stable")[:MAX_PHOTOGRAPHS]
    return _Evidence(points, count, seen_past, [int(i) for i in most if overlap[i]])


def _colour_range(view: View, probe: ProbeView, background: Color) -> ColourRange:
    """The colours of a photograph. One gain a channel, by least squares, makes it match the render
    of the training view, whose exposure may be another."""
    height, width = probe.depth.shape
    pixels = resize_area(load_view(view).over(background), width, height)
    photograph, render = (values.astype(np.float32) / 255 for values in (pixels, probe.rgb))
    p, r = (values[probe.valid] for values in (photograph, render))
    square = (p * p).sum(axis=0)
    gain = np.where(square > 0, (p * r).sum(axis=0) / np.maximum(square, 1e-9), 1).clip(*GAINS)
    near = neighbourhood(photograph * gain.astype(np.float32))
    return ColourRange(
        np.minimum.reduce(near).reshape(-1, 3), np.maximum.reduce(near).reshape(-1, 3)
    )


def _judge(
    probe: ProbeView,
    evidence: _Evidence,
    training: TrainingViews,
    agreed: Doubles,
    colours: dict[int, ColourRange],
    step: int,
) -> Contradictions:
    points = evidence.points
    sampled = slice(step // 2, None, step)
    depth, smooth = (values[sampled, sampled] for values in (probe.depth, _mean_colours(probe.rgb)))
    shape, shown = depth.shape, smooth.reshape(-1, 3)
    difference = np.full(len(points), np.inf, np.float32)
    for i in evidence.photographs:
        visibility = find_visible(training.probes[i], points.xyz, points.empty)
        seen, (low, high) = visibility.visible, colours[i]
        low, high, colour = low[visibility.pixel], high[visibility.pixel], shown[seen]
        outside = np.maximum(np.maximum(low - colour, colour - high), 0).max(axis=1)
        difference[seen] = np.minimum(difference[seen], outside)
    veiled = np.isfinite(difference) & (difference > MIN_DIFFERENCE)
    near = depth.ravel() < NEAR_SHARE * _nearest(probe, agreed)
    few = ~points.empty & (evidence.count < MIN_AGREEING)
    contradicted = veiled | (few & (near | (evidence.seen_past >= MIN_AGREEING)))
    unseen = (evidence.count == 0) & ~contradicted
    return Contradictions(contradicted.reshape(shape), unseen.reshape(shape))


def _mean_colours(rgb: NDArray[np.uint8]) -> NDArray[Any]:
    """(H, W, 3) float32 means in [0, 1] over the 3 x 3 neighbourhoods."""
    return np.add.reduce(neighbourhood(rgb.astype(np.float32))) / np.float32(9 * 255)


def _nearest(probe: ProbeView, agreed: Doubles) -> float:
    """The distance of the nearest points (2nd percentile) inside the image, whether or not
    something hides them; 0 without points."""
    inside, _, z = project(probe.view, agreed)
    return float(np.percentile(z[inside], 2)) if len(inside) else 0.0
