"""The photographs' own names: stages write images under names of their own, such as PNG files of
undistorted JPEG files."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import PurePosixPath

from pipeline.coverage.record import CoverageRecord
from pipeline.reporting.data import SceneResults


def own_names(views: Iterable[str], photographs: Iterable[str]) -> dict[str, str]:
    """View -> its photograph's name, for views whose name differs in the suffix alone.

    Args:
        views: The names of the views.
        photographs: The names of the scene's photographs.
    """
    by_stem: dict[str, list[str]] = {}
    for name in photographs:
        by_stem.setdefault(_stem(name), []).append(name)
    found = {}
    for view in views:
        names = by_stem.get(_stem(view), [])
        if len(names) == 1 and names[0] != view:
            found[view] = names[0]
    return found


def with_own_names(results: SceneResults) -> SceneResults:
    """The results with the photographs' names wherever views are named."""
    names = results.own_names
    if not names:
        return results

    def renamed(name: str) -> str:
        return names.get(name, name)

    pattern = re.compile("|".join(sorted(map(re.escape, names), key=len, reverse=True)))

    def mended(text: str) -> str:
        return pattern.sub(lambda match: names[match[0]], text)

    metrics, trained, record = results.metrics, results.trained, results.coverage.record
    floaters = record.floaters and record.floaters.model_copy(
        update={"by_camera": {renamed(n): k for n, k in record.floaters.by_camera.items()}}
    )
    changed = record.model_copy(
        update={
            "views": tuple(v.model_copy(update={"name": renamed(v.name)}) for v in record.views),
            "viewpoints": tuple(
                v.model_copy(update={"description": mended(v.description)})
                for v in record.viewpoints
            ),
            "floaters": floaters,
        }
    )
    assert isinstance(changed, CoverageRecord)
    return replace(
        results,
        metrics=metrics.model_copy(
            update={
                "per_view": tuple(
                    view.model_copy(update={"name": renamed(view.name)})
                    for view in metrics.per_view
                ),
                "warnings": [mended(text) for text in metrics.warnings],
            }
        ),
        trained=replace(
            trained,
            views=[replace(view, name=renamed(view.name)) for view in trained.views],
            orientations={renamed(name): value for name, value in trained.orientations.items()},
        ),
        comparisons=[replace(view, name=renamed(view.name)) for view in results.comparisons],
        coverage=replace(results.coverage, record=changed),
    )


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))
