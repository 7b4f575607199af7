"""The rasterizer's tables from the records that ``python -m benchmarks.raster --json`` wrote."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks import markdown

PHASES = [
    *("projection, SH", "bin", "blend", "loss", "blend backward", "projection, SH backward"),
    *("Adam", "step"),
]


def column(record: dict[str, Any], result: dict[str, Any]) -> list[str]:
    """A scene's cells: what was measured on what, then wall ms and share of the peak."""
    count, (width, height) = result["gaussians"], result["size"]
    cells = [
        f"{record['target']}, {result['threads']} threads, {count // 1000}k at {width}x{height}"
    ]
    for operator in map(result["operators"].get, PHASES):
        share = f" ({operator['of_peak']:.2f})" if "of_peak" in operator else ""
        cells.append(f"{operator['ms']['median']:.3g}{share}")
    return cells


def table(records: Sequence[dict[str, Any]]) -> str:
    """One column for each scene and number of threads of each record."""
    columns = [["", *PHASES]]
    columns += [column(record, result) for record in records for result in record["results"]]
    return markdown.table(list(zip(*columns, strict=True)))


def steps_table(records: Sequence[dict[str, Any]]) -> str:
    """The medians of a step's phases in each build of one record, ms of wall time."""
    (record,) = records
    builds: dict[str, dict[str, float]] = record["ms"]
    rows = [["", *builds]]
    rows += [[phase, *(f"{ms[phase]:.2f}" for ms in builds.values())] for phase in PHASES]
    return markdown.table(rows)
