"""Markdown tables."""

from __future__ import annotations

import statistics
from collections.abc import Sequence


def line(cells: Sequence[str]) -> str:
    """One row of a table."""
    return "| " + " | ".join(cells) + " |"


def table(rows: Sequence[Sequence[str]]) -> str:
    """A table whose first row is the heading, with a newline at its end."""
    lines = [line(cells) for cells in rows]
    lines.insert(1, "|---" * len(rows[0]) + "|")
    return "\n".join(lines) + "\n"


def cell(value: float | None, form: str) -> str:
    """The formatted value; a dash for None."""
    return "-" if value is None else format(value, form)


def middle(values: Sequence[float], form: str) -> str:
    """The median, and of several values half their range, in a format such as "{:.2f}"."""
    median = form.format(statistics.median(values))
    if len(values) == 1:
        return median
    return f"{median} ±{form.format((max(values) - min(values)) / 2)}"
