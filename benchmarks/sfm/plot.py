"""Time against error as one SVG file: a chart a scene, with its Pareto front."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from pipeline.reporting.charts import ChartPoint, trade_off_chart
from pipeline.reporting.text import escape

_WIDTH, _HEIGHT, _HEAD = 440, 250, 26
# The charts take their colours from the page; a file of its own brings them.
_STYLE = (
    "svg{--accent:#0d7d74;--train:#2f6fde;--test:#e07a10;--good:#2c8a4b;--bad:#c8362f;"
    "--ink:#16191d;--soft:#5d6673;--line:#e1e4e9;background:#fff}"
    "text{font:11px system-ui,sans-serif;fill:var(--soft)}"
    ".name,.title{fill:var(--ink);font-weight:600}.title{font-size:13px}"
    ".grid{stroke:var(--line)}.axis{stroke:var(--soft)}"
    ".front{fill:none;stroke:var(--soft);stroke-dasharray:4 3}"
)


def pareto_svg(charts: Mapping[str, Sequence[ChartPoint]]) -> str:
    """Charts under one another, by their titles. Error labels are plain numbers."""
    parts = []
    for index, (title, dots) in enumerate(charts.items()):
        figure = trade_off_chart(
            dots, title=title, x_title="CPU time, min:s", y_label=lambda value: f"{value:.3g}"
        )
        drawn = re.search(r"<svg[^>]*>(.*)</svg>", figure, re.S)
        assert drawn is not None
        top = index * (_HEIGHT + _HEAD)
        parts.append(
            f'<text class="title" x="10" y="{top + 18}">{escape(title)}</text>'
            f'<svg y="{top + _HEAD}" width="{_WIDTH}" height="{_HEIGHT}">{drawn[1]}</svg>'
        )
    height = max(1, len(charts)) * (_HEIGHT + _HEAD)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" '
        f'role="img"><style>{_STYLE}</style>{"".join(parts)}</svg>\n'
    )
