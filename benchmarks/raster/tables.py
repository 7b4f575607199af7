"""The rasterizer's tables from the records that ``python -m benchmarks.raster --json`` wrote."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from benchmarks import markdown

# The phases of all records, some of which measured the parts of the last one but the step.
PHASES = [
    *("projection, SH", "bin", "blend", "loss", "blend backward", "projection, SH backward"),
    *("Adam", "projection backward, Adam", "step"),
]


def phases_of(found: Iterable[Mapping[str, Any]]) -> list[str]:
    """The phases that any of these have."""
    known = [set(each) for each in found]
    return [phase for phase in PHASES if any(phase in each for each in known)]


def column(record: dict[str, Any], result: dict[str, Any], phases: Sequence[str]) -> list[str]:
    """A scene's cells: what was measured on what, then wall ms and share of the peak."""
    count, (width, height) = result["gaussians"], result["size"]
    cells = [
        f"{record['target']}, {result['threads']} threads, {count // 1000}k at {width}x{height}"
    ]
    for operator in map(result["operators"].get, phases):
        if operator is None:
            cells.append("")
            continue
        share = f" ({operator['of_peak']:.2f})" if "of_peak" in operator else ""
        cells.append(f"{operator['ms']['median']:.3g}{share}")
    return cells


def table(records: Sequence[dict[str, Any]]) -> str:
    """One column for each scene and number of threads of each record."""
    results = [(record, result) for record in records for result in record["results"]]
    phases = phases_of(result["operators"] for _, result in results)
    columns = [["", *phases], *(column(*each, phases) for each in results)]
    return markdown.table(list(zip(*columns, strict=True)))


def steps_table(records: Sequence[dict[str, Any]]) -> str:
    """The medians of a step's phases in each build of one record, ms of wall time."""
    (record,) = records
    builds: dict[str, dict[str, float]] = record["ms"]
    rows = [["", *builds]]
    for phase in phases_of(builds.values()):
        cells = (f"{ms[phase]:.2f}" if phase in ms else "" for ms in builds.values())
        rows.append([phase, *cells])
    return markdown.table(rows)
