"""Diagram of the plan of a scene: stages that run with their inputs, and skipped stages."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping

from pipeline.plan.record import PlanRecord
from pipeline.plan.values import StagePlan
from pipeline.reporting.text import escape

_BOX_W, _BOX_H = 92, 34
_GAP_X, _GAP_Y = 26, 16
_MARGIN = 8
_REASON_CHARS, _REASON_LINES, _LINE_H = 20, 5, 12
# Colours are CSS variables of the page, if there are any, so that the theme applies.
_STYLE = (
    ".plan text{font:600 13px system-ui,sans-serif;fill:var(--ink,#16191d);text-anchor:middle}"
    ".plan .why{font-size:10px;font-weight:400;fill:var(--soft,#5d6673)}"
    ".plan rect{fill:var(--card,#fff);stroke:var(--accent,#0d7d74);stroke-width:1.5}"
    ".plan .skipped rect{stroke:var(--soft,#5d6673);stroke-width:1;stroke-dasharray:4 3;"
    "fill:none}.plan .skipped .name{fill:var(--soft,#5d6673);font-weight:400}"
    ".plan path{fill:none;stroke:var(--accent,#0d7d74);stroke-width:1.5}"
    ".plan .head{fill:var(--accent,#0d7d74);stroke:none}"
)


def plan_svg(plan: PlanRecord) -> str:
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
    parts = [_arrow(corner[source], corner[target]) for source, target in edges]
    parts += [_box(name, stage, *corner[name]) for name, stage in stages.items()]
    label = escape(f"plan of {plan.scene}")
    return (
        f'<svg class="plan" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'role="img" aria-label="{label}"><style>{_STYLE}</style>{"".join(parts)}</svg>'
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


def _box(name: str, stage: StagePlan, x: float, y: float) -> str:
    tip = "\n".join([stage.reason, *stage.decisions])
    why = "" if stage.run else _reason(stage.reason, x + _BOX_W / 2, y + _BOX_H + _LINE_H)
    return (
        f'<g class="{"run" if stage.run else "skipped"}"><title>{escape(name)}: {escape(tip)}'
        f'</title><rect x="{x}" y="{y}" width="{_BOX_W}" height="{_BOX_H}" rx="8"/>'
        f'<text class="name" x="{x + _BOX_W / 2}" y="{y + _BOX_H / 2 + 4.5}">{escape(name)}</text>'
        f"{why}</g>"
    )


def _reason(text: str, x: float, y: float) -> str:
    lines = textwrap.wrap(text, _REASON_CHARS, max_lines=_REASON_LINES, placeholder=" \u2026")
    return "".join(
        f'<text class="why" x="{x}" y="{y + i * _LINE_H}">{escape(line)}</text>'
        for i, line in enumerate(lines)
    )


def _arrow(source: tuple[float, float], target: tuple[float, float]) -> str:
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
    return (
        f'<path d="M{x0} {y0} {middle} L{x1 - 5} {y1}"/>'
        f'<path class="head" d="M{x1} {y1} l-8 -4.5 v9 z"/>'
    )
