"""Diagram of the plan of a scene: stages that run with their inputs, and skipped stages."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping

from markupsafe import Markup

from pipeline.plan.record import PlanRecord
from pipeline.plan.values import StagePlan
from pipeline.reporting.html import render

_BOX_W, _BOX_H = 92, 34
_GAP_X, _GAP_Y = 26, 16
_MARGIN = 8
_REASON_CHARS, _REASON_LINES, _LINE_H = 20, 5, 12


def plan_svg(plan: PlanRecord) -> Markup:
    """The plan as an ``<svg>`` element, for a page or as a separate file.

    Returns:
        Running stages from left to right, with arrows from their inputs (without those implied by
        a longer path); below them, dashed, the skipped stages with the reason. The tooltip of
        each box has its reason and decisions.
    """
    stages = {name: plan.stages[name] for name in plan.order}
    edges = _edges(stages)
    places, columns, lanes = _places(stages, edges)
    skip_y = _MARGIN + lanes * (_BOX_H + _GAP_Y)
    skipped = any(not stage.run for stage in stages.values())
    height = skip_y - _GAP_Y + _MARGIN
    if skipped:
        height = skip_y + _BOX_H + _REASON_LINES * _LINE_H + _MARGIN
    width = 2 * _MARGIN + columns * (_BOX_W + _GAP_X) - _GAP_X
    corner = {
        name: (
            _MARGIN + column * (_BOX_W + _GAP_X),
            _MARGIN + lane * (_BOX_H + _GAP_Y) if stages[name].run else skip_y,
        )
        for name, (column, lane) in places.items()
    }
    boxes = [
        {"name": name, "stage": stage, "x": corner[name][0], "y": corner[name][1]}
        | {"reason": [] if stage.run else _reason(stage.reason)}
        for name, stage in stages.items()
    ]
    return render(
        "plan.svg.jinja",
        scene=plan.scene,
        width=width,
        height=height,
        arrows=[_arrow(corner[source], corner[target]) for source, target in edges],
        boxes=boxes,
        box_width=_BOX_W,
        box_height=_BOX_H,
        line_height=_LINE_H,
    )


def _edges(stages: Mapping[str, StagePlan]) -> list[tuple[str, str]]:
    """Edges from inputs to stages, without those implied by a longer path."""
    inputs = {name: stage.inputs for name, stage in stages.items()}

    def reaches(target: str) -> set[str]:
        found: set[str] = set()
        queue = list(inputs[target])
        while queue:
            name = queue.pop()
            if name not in found:
                found.add(name)
                queue += inputs[name]
        return found

    before = {name: reaches(name) for name in stages}
    return [
        (source, target)
        for target, sources in inputs.items()
        for source in sources
        if not any(source in before[other] for other in sources)
    ]


def _places(
    stages: Mapping[str, StagePlan], edges: list[tuple[str, str]]
) -> tuple[dict[str, tuple[int, int]], int, int]:
    """Column and lane of each stage, and the numbers of columns and lanes. A running stage that
    does not depend on the one before it is placed below that, in the same column."""
    places: dict[str, tuple[int, int]] = {}
    column, lane, lanes = -1, 0, 1
    in_column: set[str] = set()
    for name, stage in stages.items():
        depends = any(target == name and source in in_column for source, target in edges)
        if stage.run and in_column and not depends and any(t == name for _, t in edges):
            lane += 1
        else:
            column, lane, in_column = column + 1, 0, set()
        if stage.run:
            in_column.add(name)
        lanes = max(lanes, lane + 1)
        places[name] = (column, lane)
    return places, column + 1, lanes


def _reason(text: str) -> list[str]:
    """The lines below the box of a skipped stage."""
    return textwrap.wrap(text, _REASON_CHARS, max_lines=_REASON_LINES, placeholder=" \u2026")


def _arrow(source: tuple[float, float], target: tuple[float, float]) -> tuple[str, float, float]:
    """The path of an arrow, and where its head ends."""
    x0, y0 = source[0] + _BOX_W, source[1] + _BOX_H / 2
    x1, y1 = target[0], target[1] + _BOX_H / 2
    # Bends lie next to the boxes: other boxes may be in between.
    bend = _GAP_X / 2
    middle = (
        f"L{x0} {y0}" if y0 == y1 else f"C{x0 + bend} {y0} {x0 + bend} {y1} {x0 + 2 * bend} {y1}"
    )
    if y1 < y0:
        start = x1 - 2 * bend
        middle = f"L{start} {y0} C{start + bend} {y0} {start + bend} {y1} {x1 - 6} {y1}"
    return f"M{x0} {y0} {middle} L{x1 - 5} {y1}", x1, y1
