"""Writes the tables and figures of the docs from stored records: ``python -m benchmarks.tables``.

A table stands below a line ``<!-- KIND: RECORD [RECORD ...] -->``, of records in
``benchmarks/records``; a figure within a sentence stands in
``<!-- figure: RECORD NAME -->...<!-- end -->``. ``--check`` writes nothing and exits with 1 where a
page and its records differ.
"""

from __future__ import annotations

import json
import re
import statistics
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import markdown, record_tables
from benchmarks.raster.tables import steps_table, table
from benchmarks.record import POSES
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError

ROOT = Path(__file__).parents[1]
RECORDS = ROOT / "benchmarks" / "records"
Record = dict[str, Any]
# The stages of a scene of one block, in the order of the DAG.
STAGES = (
    *("inspect", "decode", "extract", "features", "pairs", "match", "matches", "sfm", "refine"),
    *("undistort", "dense", "init", "train", "evaluate", "coverage", "export", "report"),
)


def pages() -> list[Path]:
    """Every page whose figures come from records."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def scenes(records: Sequence[Record]) -> str:
    """A row for each scene: quality, pose errors and CPU minutes."""
    head = [
        *("scene", "training", "photographs", "test views, pixels", "seeds", "PSNR (dB)", "SSIM"),
        *("Gaussians", "with a pose", "rotation, centre error", "CPU min: poses, training, all"),
        *("memory", "where"),
    ]
    rows = [head]
    for record in records:
        runs, protocol = record["runs"], record["protocol"]
        error = runs[0]["pose_error"]
        poses = ""
        if error is not None:
            rotation = statistics.median(run["pose_error"]["rotation_median_deg"] for run in runs)
            centre = statistics.median(run["pose_error"]["centre_relative_median"] for run in runs)
            poses = f"{rotation:.3f}°, {centre:.2%}"
        minutes = [
            _minutes(runs, stages) for stages in (POSES, ("train",), tuple(runs[0]["cpu_s"]))
        ]
        if "report" not in runs[0]["cpu_s"]:  # The record is of training alone.
            minutes[2] = "-"
        rows.append(
            [
                record["scene"],
                record["training"],
                str(record["photographs"]),
                f"{protocol['num_views']}, {', '.join(protocol['resolution'])}",
                str(len(runs)),
                markdown.middle([run["psnr"] for run in runs], "{:.2f}"),
                markdown.middle([run["ssim"] for run in runs], "{:.3f}"),
                f"{statistics.median(run['gaussians'] for run in runs) / 1e3:.0f}k",
                f"{min(run['registered'] for run in runs)}",
                poses,
                ", ".join(minutes),
                _memory(runs),
                f"{record['cores']} cores, {record['instruction_set']}",
            ]
        )
    return markdown.table(rows)


def headline(records: Sequence[Record]) -> str:
    """The short table of the README, of scenes and of budgets."""
    head = ["scene", "training", "test views, pixels", "seeds", "PSNR (dB)", "SSIM", "Gaussians"]
    rows = [[*head, "CPU minutes in all", "where"]]
    for record in records:
        if "runs" not in record:
            rows += _headline_of_budgets(record)
            continue
        runs, protocol, scene = record["runs"], record["protocol"], record["scene"]
        rows.append(
            [
                scene,
                record["training"],
                f"{protocol['num_views']}, {', '.join(protocol['resolution'])}",
                str(len(runs)),
                markdown.middle([run["psnr"] for run in runs], "{:.2f}"),
                markdown.middle([run["ssim"] for run in runs], "{:.3f}"),
                f"{statistics.median(run['gaussians'] for run in runs) / 1e3:.0f}k",
                markdown.middle([sum(run["cpu_s"].values()) / 60 for run in runs], "{:.1f}"),
                f"{record['cores']} cores, {record['instruction_set']}",
            ]
        )
    return markdown.table(rows)


def _headline_of_budgets(record: Record) -> list[list[str]]:
    """A row for each time budget."""
    rows = []
    results = [result for result in record["results"] if result["trainer"] == "splatmake"]
    for minutes in sorted({result["minutes"] for result in results}):
        runs = [result for result in results if result["minutes"] == minutes]
        cpu = [run["cpu_minutes"] + run["other_cpu_minutes"] for run in runs]
        rows.append(
            [
                runs[0]["scene"],
                f"{minutes:g} min, {runs[0]['threads']} threads",
                f"{runs[0]['test_views']}, {runs[0]['pixels']}",
                str(len(runs)),
                markdown.middle([run["psnr"] for run in runs], "{:.2f}"),
                markdown.middle([run["ssim"] for run in runs], "{:.3f}"),
                f"{statistics.median(run['gaussians'] for run in runs) / 1e3:.0f}k",
                markdown.middle(cpu, "{:.1f}"),
                f"{record['cores']} cores, {record['instruction_set']}",
            ]
        )
    return rows


def sources(records: Sequence[Record]) -> str:
    """Where and how scenes, or the records of benchmarks, were measured."""
    what = "scene" if "scene" in records[0] else "benchmark"
    rows = [[what, "command", "commit", "date", "processor", "instruction set", "remark"]]
    for record in records:
        processor = f"{record['processor']}, {record['cores']} cores"
        rows.append(
            [
                record[what],
                f"`{record['command']}`",
                record["commit"][:7],
                record["date"],
                processor,
                record["instruction_set"],
                record["note"],
            ]
        )
    return markdown.table(rows)


def _memory(runs: Sequence[Record]) -> str:
    known = [run["peak_mb"] for run in runs if run["peak_mb"] is not None]
    return f"{max(known) / 1e3:.1f} GB" if known else ""


def _minutes(runs: Sequence[Record], stages: Sequence[str]) -> str:
    """The CPU minutes of some stages; a dash where none was recorded."""
    if not runs[0]["cpu_s"].keys() & set(stages):
        return "-"
    sums = [sum(run["cpu_s"].get(stage, 0.0) for stage in stages) / 60 for run in runs]
    return markdown.middle(sums, "{:.1f}")


def stages(records: Sequence[Record]) -> str:
    """The CPU seconds of each stage of one scene, in the order of the DAG, and their sum."""
    (record,) = records
    seconds = record["runs"][0]["cpu_s"]
    order = [name for name in STAGES if name in seconds]
    rows = [["stage", "CPU s"], *([name, f"{seconds[name]:.0f}"] for name in order)]
    return markdown.table([*rows, ["all", f"{sum(seconds.values()):.0f}"]])


KINDS: dict[str, Callable[[Sequence[Record]], str]] = {
    "raster": table,
    "raster-steps": steps_table,
    "scenes": scenes,
    "headline": headline,
    "sources": sources,
    "stages": stages,
    **{kind: partial(record_tables.table_of, kind) for kind in record_tables.TABLES},
}
MARKER = re.compile(
    rf"<!-- ({'|'.join(map(re.escape, KINDS))}): ([^>]+) -->\n(?:\n(?:\|[^\n]*\n)+)?"
)
FIGURE = re.compile(r"<!-- figure: (\S+) (\S+) -->.*?<!-- end -->", re.DOTALL)


def read_record(name: str) -> Record:
    """A record of ``RECORDS``.

    Raises:
        UserError: It is missing, or not JSON.
    """
    try:
        record: Record = json.loads((RECORDS / name).read_text())
    except (OSError, ValueError) as error:
        raise UserError(
            f"expected a record: {error}",
            file=RECORDS / name,
            fix="write it by a benchmark's --json, or take its table off the page",
        ) from error
    return record


def rewritten(page: str) -> str:
    """The page with its tables and figures made anew."""

    def fill(match: re.Match[str]) -> str:
        kind, names = match[1], match[2].split()
        made = KINDS[kind]([read_record(name) for name in names])
        return f"<!-- {kind}: {' '.join(names)} -->\n\n{made}"

    def figure(match: re.Match[str]) -> str:
        name, key = match[1], match[2]
        value = read_record(name)["figures"][key]
        return f"<!-- figure: {name} {key} -->{value}<!-- end -->"

    return FIGURE.sub(figure, MARKER.sub(fill, page))


def figures_outside(page: str) -> list[str]:
    """Measured values of a page that no record stands behind."""
    rest = FIGURE.sub("", MARKER.sub("", page))
    rest = re.sub(r"```.*?```", "", rest, flags=re.DOTALL)
    return re.findall(r"\b\d[\d ,.]*\s(?:dB|CPU s|CPU min|GFLOP/s|frames a second)\b", rest)


def main() -> int:
    check, stale = "--check" in sys.argv[1:], []
    for page in pages():
        text = page.read_text()
        new = rewritten(text)
        if new != text:
            stale.append(page.relative_to(ROOT))
            if not check:
                page.write_text(new)
    for path in stale:
        print(f"{path}: {'differs from its records' if check else 'written'}")
    return 1 if check and stale else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(EXIT_USER_ERROR)
