"""What a novel view shows although the photographs contradict it: floaters, veils and haze.

A pixel of a novel view is contradicted if

- it shows something nearer than half the distance of the nearest surface in view on which two
  training views agree, and fewer than two see it: a surface, or a veil, without which the pixel's
  colour would be another one; or
- it shows a surface that training views see, in a colour that none of their photographs has there.

A pixel whose surface no training view sees is unseen: nothing is known of what belongs there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.coverage.defects import MIN_AGREEING, NEAR_SHARE
from pipeline.coverage.novel_views import KINDS, Kind, NovelView, choose_novel_views
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
    render_probes,
    rotate,
)
from pipeline.coverage.training_views import TrainingViews
from pipeline.photos.load import load_view, resize_area
from pipeline.render import BACKGROUNDS, Color, RasterOptions
from pipeline.render.views import render_view, to_bytes
from pipeline.runtime.progress import track
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians

Picture = NDArray[np.uint8]

#: Number of photographs, those that see most of a novel view, whose colours are compared.
MAX_PHOTOGRAPHS = 4
#: Difference of colours in [0, 1], in the channel that differs most, that counts.
MIN_DIFFERENCE = 0.1
#: Bounds of the gain by which a photograph is multiplied to match its render's exposure.
GAINS = 0.5, 2.0
#: A photograph that differs from its render in more than this share of pixels is in another light.
MAX_OUTSIDE = 0.5
#: Stride of the compared pixels, in both directions.
PIXEL_STEP = 2
CONTRADICTED_COLOUR, UNSEEN_COLOUR = (255, 150, 0), (45, 65, 140)


@dataclass(frozen=True)
class NovelProbe:
    """A novel view, rendered.

    Attributes:
        near: See ``empty_depth``.
        beyond: (H, W, 3) the render without the Gaussians up to ``near``.
    """

    probe: ProbeView
    near: float
    beyond: Picture


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
        count: (N,) number of training views that see the point.
        photographs: Indices of the training views that see most of the points, at most
            ``MAX_PHOTOGRAPHS``.
    """

    points: QueryPoints
    count: NDArray[np.intp]
    photographs: Sequence[int]


@dataclass(frozen=True)
class NovelViews:
    """The novel views of a scene, compared with its photographs.

    Attributes:
        views: The novel views.
        probes: Their renders, in the same order.
        shares: (N, 2) shares of contradicted and of unseen pixels.
    """

    views: Sequence[NovelView]
    probes: Sequence[NovelProbe]
    shares: Doubles

    def by_kind(self) -> dict[Kind, tuple[int, Doubles]]:
        """The number of views of each kind that has one, and their mean shares."""
        kinds = {kind: [view.kind == kind for view in self.views] for kind in KINDS}
        return {
            kind: (sum(which), self.shares[which].mean(axis=0))
            for kind, which in kinds.items()
            if any(which)
        }


def compare_novel_views(
    training: TrainingViews,
    up: Doubles,
    gaussians: Gaussians,
    options: RasterOptions,
) -> NovelViews | None:
    """Choose novel views and compare them with the photographs; None if there is no free place.

    Args:
        up: (3,) up vector of the world.
        options: How views are rendered. The number of threads does not affect results.
    """
    novel = choose_novel_views(training, up)
    rendered = render_novel_views([item.view for item in novel], training, gaussians, options)
    shown = list(track(rendered, "rendering novel views", len(novel), unit="views"))
    found = find_contradictions(shown, training, options.background, options.threads, PIXEL_STEP)
    shares = [(item.contradicted.mean(), item.unseen.mean()) for item in found]
    return NovelViews(novel, shown, np.array(shares)) if novel else None


def render_novel_views(
    views: Sequence[View], training: TrainingViews, gaussians: Gaussians, options: RasterOptions
) -> Iterator[NovelProbe]:
    """Render views at reduced size, one at a time."""
    agreed, means = training.surface.agreed(MIN_AGREEING), gaussians.arrays()["means"]
    for probe in render_probes(views, lambda view: render_view(gaussians, view, options)):
        near, beyond = empty_depth(probe.view, agreed), probe.rgb
        if _any_near(probe.view, means, near):
            farther = replace(options, near=max(near, options.near))
            beyond = to_bytes(render_view(gaussians, probe.view, farther).rgb)
        yield NovelProbe(probe, near, beyond)


def empty_depth(view: View, agreed: Doubles) -> float:
    """The depth up to which a view sees empty space: half the distance of the nearest surface in
    view on which two training views agree, world units; 0 if there is none.

    Args:
        agreed: (N, 3) points of that surface.
    """
    inside, _, z = project(view, agreed)
    # The 2nd percentile of the points inside the image, whether or not something hides them.
    return NEAR_SHARE * float(np.percentile(z[inside], 2)) if len(inside) else 0.0


def _any_near(view: View, means: Floats, near: float) -> bool:
    """Whether a point has a camera z between 0 and ``near``, up to 60 degrees from the axis."""
    offset = means - view.centre.astype(np.float32)
    z = rotate(offset, view.world_to_camera[2:3, :3].astype(np.float32))[:, 0]
    close = (z > 0) & (z < near)
    return bool(((offset[close] ** 2).sum(axis=1) < 4 * z[close] ** 2).any())


def find_contradictions(
    shown: Sequence[NovelProbe],
    training: TrainingViews,
    background: Color | None,
    threads: int,
    step: int = 1,
) -> list[Contradictions]:
    """Compare novel views with the training views and their photographs.

    Args:
        background: The colour behind photographs with an alpha channel; None for black.
        threads: The number of views at a time, which does not affect results.
        step: The stride of the compared pixels.
    """
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        found = list(pool.map(lambda novel: _evidence(novel.probe, training, step), shown))
        # One at a time, since each takes memory for a photograph at full size.
        colours = {
            i: _colour_range(training.views[i], training.probes[i], background)
            for i in sorted({i for evidence in found for i in evidence.photographs})
        }

        def judge(novel: NovelProbe, evidence: _Evidence) -> Contradictions:
            return _judge(novel, evidence, training, colours, step)

        return list(pool.map(judge, shown, found))


def contradiction_map(probe: ProbeView, found: Contradictions) -> Picture:
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
    count = np.zeros(len(points), np.intp)
    overlap = []
    for photograph in training.probes:
        visibility = find_visible(photograph, points.xyz, points.empty)
        count[visibility.visible] += 1
        overlap.append(len(visibility.visible))
    most = np.argsort(-np.array(overlap), kind="stable")[:MAX_PHOTOGRAPHS]
    return _Evidence(points, count, [int(i) for i in most if overlap[i]])


def _colour_range(view: View, probe: ProbeView, background: Color | None) -> ColourRange:
    """The colours of a photograph. One gain a channel, by least squares, makes it match the render
    of the training view, whose exposure may be another. A photograph in another light is replaced
    by the render."""
    height, width = probe.depth.shape
    pixels = resize_area(load_view(view).over(background or BACKGROUNDS["black"]), width, height)
    photograph, render = (values.astype(np.float32) / 255 for values in (pixels, probe.rgb))
    p, r = (values[probe.valid] for values in (photograph, render))
    square = (p * p).sum(axis=0)
    gain = np.where(square > 0, (p * r).sum(axis=0) / np.maximum(square, 1e-9), 1).clip(*GAINS)
    found = _range(photograph * gain.astype(np.float32))
    outside = _outside(_smooth(probe.rgb).reshape(-1, 3), found) > MIN_DIFFERENCE
    return _range(render) if outside[probe.valid.ravel()].mean() > MAX_OUTSIDE else found


def _range(picture: NDArray[Any]) -> ColourRange:
    near = neighbourhood(picture)
    low, high = np.minimum.reduce(near), np.maximum.reduce(near)
    return ColourRange(low.reshape(-1, 3), high.reshape(-1, 3))


def _outside(colours: Floats, found: ColourRange) -> Floats:
    """(N,) how far (N, 3) colours are outside their range, in the channel that is farthest."""
    below, above = found.low - colours, colours - found.high
    return np.asarray(np.maximum(np.maximum(below, above), 0).max(axis=1))


def _smooth(picture: Picture) -> Floats:
    """(H, W, 3) means over the 3 x 3 neighbourhoods, in [0, 1]."""
    total = np.add.reduce(neighbourhood(picture.astype(np.float32)))
    return np.asarray(total / np.float32(9 * 255))


def _judge(
    novel: NovelProbe,
    evidence: _Evidence,
    training: TrainingViews,
    colours: dict[int, ColourRange],
    step: int,
) -> Contradictions:
    points = evidence.points
    sampled = slice(step // 2, None, step)
    rgb, beyond = (_smooth(p)[sampled, sampled] for p in (novel.probe.rgb, novel.beyond))
    depth = novel.probe.depth[sampled, sampled]
    few = (evidence.count < MIN_AGREEING).reshape(depth.shape)
    veiled = np.abs(rgb - beyond).max(axis=2) > MIN_DIFFERENCE
    floating = np.where(depth < novel.near, few, veiled)
    difference, shown = np.full(len(points), np.inf, np.float32), rgb.reshape(-1, 3)
    for i in evidence.photographs:
        visibility = find_visible(training.probes[i], points.xyz, points.empty)
        seen, pixel = visibility.visible, visibility.pixel
        expected = ColourRange(colours[i].low[pixel], colours[i].high[pixel])
        difference[seen] = np.minimum(difference[seen], _outside(shown[seen], expected))
    wrong = np.isfinite(difference) & (difference > MIN_DIFFERENCE)
    contradicted = floating | wrong.reshape(depth.shape)
    unseen = (evidence.count == 0).reshape(depth.shape) & ~contradicted
    return Contradictions(contradicted, unseen)
