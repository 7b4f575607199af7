"""The training views of a scene as coverage uses them: renders with depth, and a sample of the
surface that they show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from pipeline.coverage.probe_views import (
    Bools,
    Doubles,
    Floats,
    ProbeView,
    Renderer,
    backproject,
    render_probes,
)
from pipeline.coverage.trust import collect_observations
from pipeline.runtime.progress import track
from pipeline.scene.views import View, evenly_spaced

T = TypeVar("T")

#: Largest numbers of training views, and of training views whose surface points are sampled.
#: Larger sets are sampled evenly.
MAX_TRAINING_VIEWS, MAX_SAMPLED = 200, 12
#: Stride of the sampled pixels.
PIXEL_STEP = 4


@dataclass(frozen=True)
class SurfaceSample:
    """Points of the surface that some training views show and at least one of them sees.

    Attributes:
        xyz: (N, 3) world.
        depth: (N,) camera z in the view that shows the point, world units.
        count: (N,) number of training views that see the point.
        seen_past: (N,) number of training views that see a surface, or none, behind the point.
        parallax: (N,) degrees, see ``Observations.parallax``.
    """

    xyz: Doubles
    depth: Floats
    count: Floats
    seen_past: Floats
    parallax: Floats

    @property
    def nearest(self) -> float:
        """The distance from the cameras of the nearest surface (2nd percentile) that at least 3
        training views see; 0 if there is none."""
        certain = self.depth[self.count > 2]
        return float(np.percentile(certain, 2)) if len(certain) else 0.0

    def agreed(self, number: int) -> Doubles:
        """(M, 3) the points that at least ``number`` training views see."""
        return self.xyz[self.count >= number]


@dataclass(frozen=True)
class TrainingViews:
    """Training views and what the trained scene shows in them.

    Attributes:
        views: The cameras at full size, with their photographs.
        probes: The probe views of the same cameras, in the same order.
        background_depth: The depth of pixels whose ray meets no surface, world units.
        surface: A sample of the surface.
    """

    views: Sequence[View]
    probes: Sequence[ProbeView]
    background_depth: float
    surface: SurfaceSample


def render_training_views(views: Sequence[View], render: Renderer) -> TrainingViews | None:
    """Render up to ``MAX_TRAINING_VIEWS`` of the views that are not test views; None if they show
    no surface."""
    chosen = evenly_spaced([view for view in views if not view.is_test], MAX_TRAINING_VIEWS)
    rendered = render_probes(chosen, render)
    probes = list(track(rendered, "rendering training views", len(chosen), unit="views"))
    depths = np.concatenate([probe.depth[~probe.empty] for probe in probes])
    if not len(depths):
        return None
    background_depth = float(np.percentile(depths, 95))
    return TrainingViews(chosen, probes, background_depth, _surface(probes, background_depth))


def _surface(probes: Sequence[ProbeView], background_depth: float) -> SurfaceSample:
    sampled = evenly_spaced(probes, MAX_SAMPLED)
    parts: list[tuple[Doubles | Floats, ...]] = []
    for probe in track(sampled, "counting observations", len(sampled), unit="views"):
        points = backproject(probe, background_depth, PIXEL_STEP)
        observed = collect_observations(probes, points)
        keep: Bools = ~points.empty & (observed.count > 0)
        depth = probe.focal / points.resolution
        values = (points.xyz, depth, observed.count, observed.seen_past, observed.parallax)
        parts.append(tuple(value[keep] for value in values))
    return SurfaceSample(*(np.concatenate(values) for values in zip(*parts, strict=True)))
