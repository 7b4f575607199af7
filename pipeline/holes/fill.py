"""Fills the holes of a trained scene with invented Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.coverage.novel_views import choose_novel_views
from pipeline.coverage.probe_views import SIDE, Doubles
from pipeline.coverage.training_views import TrainingViews, render_training_views
from pipeline.coverage.viewpoints import propose_viewpoints
from pipeline.holes.fit import PaintedView, fit_invented, invented_weight, without_shown
from pipeline.holes.painters import Painter
from pipeline.holes.placement import HoleView, context_weights, find_holes, place_gaussians
from pipeline.render import RasterOptions, make_backend
from pipeline.render.views import Render, render_view
from pipeline.runtime.progress import track
from pipeline.scene.views import View, evenly_spaced
from pipeline.splats.gaussians import Gaussians, concat

#: Largest number of painted views.
MAX_PAINTED = 24
#: Range of the share of a painted view's pixels that are holes. A painter that sees little of the
#: scene invents freely.
MIN_SHARE, MAX_SHARE = 0.005, 0.6
#: A pixel is invented if invented Gaussians have more than this share of its colour; it is still a
#: hole up to half of it.
INVENTED_WEIGHT, FILLED_WEIGHT = 0.1, 0.5


@dataclass(frozen=True)
class FilledScene:
    """A scene whose holes are filled.

    Attributes:
        gaussians: The Gaussians of the scene as they were, followed by the invented ones.
        num_invented: The number of invented Gaussians.
        painted: The painted views, in the order of painting.
        found: The same views before painting, with their holes.
    """

    gaussians: Gaussians
    num_invented: int
    painted: Sequence[PaintedView]
    found: Sequence[HoleView]

    @property
    def first_invented(self) -> int:
        """The index of the first invented Gaussian."""
        return len(self.gaussians) - self.num_invented


def fill_holes(
    gaussians: Gaussians,
    views: Sequence[View],
    up: Doubles,
    painter: Painter,
    options: RasterOptions,
) -> FilledScene:
    """Paint the holes of views between and beside the photographs, and place Gaussians there.

    Views with small holes come first, and each shows what was invented for those before it.

    Args:
        views: All views; test views are not used.
        up: (3,) up vector of the world.
        options: How views are rendered. The number of threads does not affect results.

    Raises:
        UserError: the painter fails.
    """

    def render(view: View) -> Render:
        return render_view(gaussians, view, options)

    training = render_training_views(views, render)
    if training is None:
        return FilledScene(gaussians, 0, [], [])
    chosen = choose_views(gaussians, training, up, options)
    invented: list[Gaussians] = []
    painted, found = list[PaintedView](), list[HoleView]()
    for view in track(chosen, "painting holes", len(chosen), unit="views"):
        shown = concat([gaussians, *invented])
        holes = _open_holes(view, shown, len(gaussians), training, options)
        if holes.share < MIN_SHARE:
            continue
        image, weights = holes.probe.rgb, context_weights(holes, training.background_depth)
        painting = painter(image, holes.hole, weights)
        picture = np.where(holes.hole[..., None], painting, image)
        placed = place_gaussians(holes, picture, training, gaussians.sh_degree)
        if placed is None:
            continue
        invented.append(Gaussians.from_arrays(placed))
        painted.append(PaintedView(holes.probe.view, picture, holes.hole))
        found.append(holes)
    if not invented:
        return FilledScene(gaussians, 0, [], [])
    photographs = [view for view in views if not view.is_test]
    fitted = fit_invented(gaussians, concat(invented), painted, options)
    kept = without_shown(gaussians, fitted, photographs, options)
    return FilledScene(concat([gaussians, kept]), len(kept), painted, found)


def choose_views(
    gaussians: Gaussians, training: TrainingViews, up: Doubles, options: RasterOptions
) -> list[View]:
    """Up to ``MAX_PAINTED`` views with holes, by the share of these: the viewpoints that coverage
    proposes, and an even selection of its other candidates and novel views."""

    def render(view: View) -> Render:
        return render_view(gaussians, view, options)

    best = propose_viewpoints(
        training.views, training.probes, render, up, training.background_depth
    )
    proposed = [proposal.viewpoint.view for proposal in best.proposals]
    others = [candidate.view for candidate in best.candidates]
    others = [view for view in others if all(view is not other for other in proposed)]
    others += [novel.view for novel in choose_novel_views(training, up)]
    usable: list[tuple[float, int, View]] = []
    views = [*proposed, *others]
    for number, view in enumerate(track(views, "finding holes", len(views), unit="views")):
        share = find_holes(view, gaussians, training, options, SIDE).share
        if MIN_SHARE <= share <= MAX_SHARE:
            usable.append((share, number, view))
    usable.sort(key=lambda item: item[:2])
    first = [item for item in usable if item[1] < len(proposed)]
    rest = [item for item in usable if item[1] >= len(proposed)]
    chosen = [*first, *evenly_spaced(rest, max(MAX_PAINTED - len(first), 0))]
    return [view for _, _, view in sorted(chosen, key=lambda item: item[:2])]


def _open_holes(
    view: View, shown: Gaussians, first: int, training: TrainingViews, options: RasterOptions
) -> HoleView:
    """The holes of a view that invented Gaussians do not fill yet."""
    found = find_holes(view, shown, training, options)
    if first == len(shown):
        return found
    weight = invented_weight(shown, first, found.probe.view, options, make_backend())
    return replace(found, hole=found.hole & (weight < FILLED_WEIGHT))


def invented_pixels(scene: FilledScene, view: View, options: RasterOptions) -> np.ndarray:
    """(H, W) True in the invented pixels of a view."""
    weight = invented_weight(scene.gaussians, scene.first_invented, view, options, make_backend())
    return np.asarray(weight > INVENTED_WEIGHT)
