"""The photographs' own names on the page.

Stages that write images name them anew (``.png``): the page shows the files that the user knows.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

from pipeline.reporting.data import SceneResults


def photograph_names(views: Iterable[str], photographs: Iterable[str]) -> dict[str, str]:
    """The photograph of each view whose file has another suffix.

    Args:
        views: Names of views.
        photographs: Names of the scene's photographs. Those that differ in their suffix only are
            left out, because a view's name does not tell them apart.
    """
    named = list(photographs)
    stems = Counter(_stem(name) for name in named)
    own = {_stem(name): name for name in named if stems[_stem(name)] == 1}
    found = {view: own.get(_stem(view), view) for view in views}
    return {view: name for view, name in found.items() if view != name}


def with_photograph_names(results: SceneResults) -> SceneResults:
    """The results with the photographs' own names in all fields and texts."""
    names = results.photographs
    if not names:
        return results
    change = _changer(names)
    metrics, plan, trained = results.metrics, results.plan, results.trained
    record = results.coverage.record
    coverage = type(record).model_validate(_in_texts(record.model_dump(), change))
    measured = [v.model_copy(update={"name": change(v.name)}) for v in metrics.per_view]
    return replace(
        results,
        metrics=metrics.model_copy(
            update={"per_view": measured, "warnings": [change(w) for w in metrics.warnings]}
        ),
        plan=plan.model_copy(update={"warnings": [change(w) for w in plan.warnings]}),
        trained=replace(
            trained,
            views=[replace(view, name=change(view.name)) for view in trained.views],
            orientations={change(name): o for name, o in trained.orientations.items()},
        ),
        coverage=replace(results.coverage, record=coverage),
        decisions={stage: [change(t) for t in texts] for stage, texts in results.decisions.items()},
        comparisons=[replace(view, name=change(view.name)) for view in results.comparisons],
    )


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))


def _changer(names: Mapping[str, str]) -> Callable[[str], str]:
    """A function that replaces the names of views, as whole words, in a text."""
    longest = sorted(names, key=len, reverse=True)
    found = re.compile(rf"(?<![\w/.-])(?:{'|'.join(map(re.escape, longest))})(?![\w/-])")
    return lambda text: found.sub(lambda match: names[match[0]], text)


# The files of images in the record keep their names.
_FILES = ("render", "trust_map")


def _in_texts(value: Any, change: Callable[[str], str]) -> Any:
    match value:
        case str():
            return change(value)
        case dict():
            return {
                change(name): v if name in _FILES else _in_texts(v, change)
                for name, v in value.items()
            }
        case list() | tuple():
            return [_in_texts(v, change) for v in value]
        case _:
            return value
