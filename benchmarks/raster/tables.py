"""Writes the speed tables of a page from stored records: ``python -m benchmarks.raster.tables``.

A table stands below a line ``<!-- raster: RECORD [RECORD ...] -->``, of records in
``benchmarks/records`` that ``python -m benchmarks.raster --json`` wrote.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PAGE, RECORDS = ROOT / "docs" / "raster.md", ROOT / "benchmarks" / "records"
PHASES = [
    *("projection, SH", "bin", "blend", "loss", "blend backward", "projection, SH backward"),
    *("Adam", "step"),
]
MARKER = re.compile(r"<!-- raster: ([^>]+) -->\n(?:\|[^\n]*\n)*")


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


def table(records: list[dict[str, Any]]) -> str:
    """One column for each scene and number of threads of each record."""
    columns = [["", *PHASES]]
    columns += [column(record, result) for record in records for result in record["results"]]
    rows = ["| " + " | ".join(cells) + " |" for cells in zip(*columns, strict=True)]
    rows.insert(1, "|---" * len(columns) + "|")
    return "\n".join(rows) + "\n"


def rewritten(page: str) -> str:
    """The page with its tables made anew."""

    def fill(match: re.Match[str]) -> str:
        names = match[1].split()
        records = [json.loads((RECORDS / name).read_text()) for name in names]
        return f"<!-- raster: {' '.join(names)} -->\n{table(records)}"

    return MARKER.sub(fill, page)


if __name__ == "__main__":
    PAGE.write_text(rewritten(PAGE.read_text()))
