"""The results of runs in a few lines, for the terminal."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.config.runs import Run
from pipeline.reporting.metrics import Metrics, read_metrics, read_runs
from pipeline.reporting.verdict import verdict
from pipeline.runtime.layout import COMMAND, as_called
from pipeline.runtime.record import RECORDS
from pipeline.runtime.text import counted, duration, shortened


def headline(metrics: Metrics) -> str:
    """One line: quality, number of Gaussians, poses, warnings."""
    perceptual = "".join(
        f", {name} {value:.3f}"
        for name, value in (("FLIP", metrics.flip), ("LPIPS", metrics.lpips))
        if value is not None
    )
    pose = metrics.pose_error
    known = pose is not None and pose.rotation_median_deg is not None
    error = f", rotation error {pose.rotation_median_deg:.3f} degrees" if pose and known else ""
    warned = f", {counted(len(metrics.warnings), 'warning')}" if metrics.warnings else ""
    return (
        f"PSNR {metrics.psnr:.2f} dB, SSIM {metrics.ssim:.4f}{perceptual}, "
        f"{counted(metrics.num_gaussians, 'Gaussian')}, "
        f"{metrics.registered_images} of {metrics.total_images} photographs{error}{warned}"
    )


def finished_line(folder: Path) -> str:
    """One line on a finished run: its grade, its result, and the time that all its stages took.

    Raises:
        UserError: A record of the run is missing or damaged.
    """
    metrics = read_metrics(folder)
    return f"{metrics.scene}: {verdict(metrics).title}: {_with_time(metrics, folder)}"


def result_lines(folder: Path) -> list[str]:
    """The result of a finished run, where its files are, and a command that shows them.

    Args:
        folder: The run's folder, ``results/<run>``.

    Raises:
        UserError: A record of the run is missing or damaged.
    """
    exported = sorted(path.name for path in (folder / "export").glob("[!.]*"))
    files = [name for name in exported if name not in (*RECORDS, "frame.json", "path.json")]
    metrics = read_metrics(folder)
    found = verdict(metrics)
    return [
        f"{metrics.scene}: {found.title}: {found.sentence}",
        f"  {_with_time(metrics, folder)}",
        f"  page     {as_called(folder / 'report.html')}",
        *([f"  exports  {as_called(folder / 'export')}: {', '.join(files)}"] if files else []),
        f"  next     {COMMAND} view {shlex.quote(str(as_called(folder)))}",
    ]


def _with_time(metrics: Metrics, folder: Path) -> str:
    runs = read_runs(metrics, folder).values()
    return f"{headline(metrics)}, {duration(sum(run.wall_s + run.earlier_s for run in runs))}"


def batch_lines(results: Path) -> list[str]:
    """The table of a batch, and where its page is.

    Args:
        results: The folder with ``benchmark.json`` and ``index.html``.
    """
    rows = json.loads((results / "benchmark.json").read_text())["runs"]
    seeded = len({row["seed"] for row in rows} - {None}) > 1
    cells: list[tuple[str, ...]] = [("run", "PSNR", "SSIM", "Gaussians", "time", "")]
    cells += [_cells(row, seeded) for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return [_aligned(line, widths) for line in cells] + [
        f"  page  {as_called(results / 'index.html')}"
    ]


def _cells(row: dict[str, Any], seeded: bool) -> tuple[str, ...]:
    name = Run(row["scene"], row["config"], row["seed"] if seeded else None).name
    if row["status"] != "ok":
        at = f" in {row['failed_stage']}" if row["failed_stage"] else ""
        return name, "", "", "", "", f"{row['status']}{at}: {shortened(row['message'], 80)}"
    return (
        name,
        f"{row['psnr']:.2f} dB",
        f"{row['ssim']:.4f}",
        f"{row['num_gaussians']:,}",
        duration(row["wall_s"]),
        counted(row["warnings"], "warning") if row["warnings"] else "",
    )


def _aligned(cells: Sequence[str], widths: Sequence[int]) -> str:
    first, *middle, last = zip(cells, widths, strict=True)
    numbers = "".join(f"  {cell:>{width}}" for cell, width in middle)
    return f"  {first[0]:<{first[1]}}{numbers}  {last[0]}".rstrip()
