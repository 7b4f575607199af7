"""Tables of the runs of a batch, of differences between its configurations, or between two batches.

    splatmake compare results --each
    splatmake compare results --base balanced
    splatmake compare first/results results

prints the table as Markdown. ``config/ablations.yaml`` and ``config/skipping.yaml`` define batches
for such comparisons.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.config.runs import Run
from pipeline.io.bounded import MIB, read_bounded
from pipeline.runtime.errors import UserError
from pipeline.runtime.layout import COMMAND
from pipeline.runtime.suggest import check_exists, did_you_mean, nearest

# Identical, to the bit, for repeated runs on the same machine.
QUALITY = (
    "psnr",
    "ssim",
    "train_psnr",
    "num_gaussians",
    "registered_images",
    "reprojection_error_px",
    "rotation_error_deg",
    "centre_error_share",
)
# Stages whose times are compared.
POSES = (
    *("decode", "extract", "features", "pairs", "match", "matches", "sfm"),
    *("refine", "undistort"),
)
WORK = (*POSES, "train")
# A batch of 200,000 runs.
_MAX_BYTES = 256 * MIB
_FIX = f"create one: {COMMAND} batch FOLDER"

Row = dict[str, Any]


def each_run(rows: Sequence[Row]) -> list[str]:
    """One row per run: quality, and wall time in seconds of groups of stages."""
    lines = [
        "| run | PSNR | on training views | SSIM | Gaussians | posed | rotation, centres | poses s "
        "| training s | total s | peak MB | |",
        "|---" * 12 + "|",
    ]
    seeded = len({row["seed"] for row in rows}) > 1
    for row in rows:
        name = Run(row["scene"], row["config"], row["seed"] if seeded else None).name
        if row["status"] != "ok":
            lines.append(f"| {name} | {row['status']}: {row['message']} {'| ' * 10}|")
            continue
        turned, moved = row["rotation_error_deg"], row["centre_error_share"]
        known = turned is not None and moved is not None
        cells = [
            name,
            f"{row['psnr']:.2f} dB",
            "" if row["train_psnr"] is None else f"{row['train_psnr']:.2f}",
            _short(row["ssim"]),
            f"{row['num_gaussians'] / 1e3:.0f}k",
            f"{row['registered_images']}/{row['total_images']}",
            f"{turned:.3f} degrees, {moved:.2%}" if known else "",
            f"{_wall(row, POSES):.0f}",
            f"{_wall(row, ('train',)):.0f}",
            f"{row['wall_s']:.0f}",
            f"{row['peak_rss_mb']:.0f}",
            "warned" if row["warnings"] else "",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def against(rows: Sequence[Row], base: str) -> list[str]:
    """Differences of each configuration from ``base``, by scene and in the mean: PSNR (dB), SSIM
    and CPU seconds of poses and training; then these seconds separately, and Gaussians.
    Several seeds are compared seed by seed: median and half the range.
    """
    by_run = {(row["scene"], row["config"], row["seed"]): row for row in rows}
    configs, scenes, seeds = (
        list(dict.fromkeys(row[key] for row in rows)) for key in ("config", "scene", "seed")
    )
    head = "| | " + " | ".join(scenes) + " | mean | CPU s: poses, training | Gaussians |"
    lines = [head, "|---" * (len(scenes) + 4) + "|"]
    for config in configs:
        cells: list[str] = []
        gains: list[float] = []
        finished: list[list[Row]] = []
        for scene in scenes:
            found = [by_run[key] for seed in seeds if (key := (scene, config, seed)) in by_run]
            done = [row for row in found if row["status"] == "ok"]
            if not done:
                states = [f"{row['status']}: {row['message']}" for row in found]
                cells.append(states[0] if states else "no run")
                continue
            finished.append(done)
            pairs = [
                (row, other)
                for row in done
                if (other := by_run.get((scene, base, row["seed"]))) and other["status"] == "ok"
            ]
            if config == base or not pairs:
                psnr = _spread([row["psnr"] for row in done], "{:.2f}")
                ssim = _short(statistics.median(row["ssim"] for row in done))
                seconds = _spread([_cpu(row, WORK) for row in done], "{:.0f}")
                cells.append(f"{psnr} dB, {ssim}, {seconds} s")
                continue
            more = [row["psnr"] - other["psnr"] for row, other in pairs]
            gains.append(statistics.median(more))
            ssim = _short(statistics.median(r["ssim"] - o["ssim"] for r, o in pairs), "+")
            seconds = _spread(
                [_cpu(row, WORK) - _cpu(other, WORK) for row, other in pairs], "{:+.0f}"
            )
            cells.append(f"{_spread(more, '{:+.2f}')}, {ssim}, {seconds} s")
        mean = f"{statistics.fmean(gains):+.2f} dB" if gains else ""
        cost = gaussians = ""
        if finished:
            poses, training, number = (
                statistics.fmean(statistics.median(of(row) for row in done) for done in finished)
                for of in (
                    lambda row: _cpu(row, POSES),
                    lambda row: _cpu(row, ("train",)),
                    lambda row: row["num_gaussians"],
                )
            )
            cost = f"{poses:.0f}, {training:.0f}"
            gaussians = f"{number / 1e3:.0f}k"
        name = f"**{config}**" if config == base else config
        lines.append(f"| {name} | {' | '.join(cells)} | {mean} | {cost} | {gaussians} |")
    return lines


def _spread(values: Sequence[float], form: str) -> str:
    """The median and, for several values, half their range."""
    middle = form.format(statistics.median(values))
    if len(values) == 1:
        return middle
    half = form.replace("+", "").format((max(values) - min(values)) / 2)
    return f"{middle} ±{half}"


def repeated(first: Sequence[Row], second: Sequence[Row]) -> list[str]:
    """Comparison of two batches of the same runs: differences in quality, and ratios of times."""
    again = {(row["scene"], row["config"], row["seed"]): row for row in second}
    lines = ["| run | quality | wall s | CPU s |", "|---|---|---|---|"]
    ratios: dict[str, list[float]] = {"wall_s": [], "cpu_s": []}
    for row in first:
        name = "@".join(str(row[key]) for key in ("scene", "config") if row[key])
        other = again.get((row["scene"], row["config"], row["seed"]))
        if other is None or row["status"] != "ok" or other["status"] != "ok":
            states = row["status"], "no run" if other is None else other["status"]
            lines.append(f"| {name} | {states[0]}, then {states[1]} | | |")
            continue
        differ = [f"{key} {row[key]} and {other[key]}" for key in QUALITY if row[key] != other[key]]
        cells = [", ".join(differ) or "the same"]
        for key, found in ratios.items():
            # Stages reused from another run are counted with that run's time.
            found.append(other[key] / row[key])
            cells.append(f"{row[key]:.0f}, {other[key]:.0f}")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    for key, found in ratios.items():
        if found:
            spread = f"{min(found):.2f} to {max(found):.2f}"
            lines.append(
                f"\n{key}, second to first: median {statistics.median(found):.2f}, {spread}"
            )
    return lines


def _wall(row: Row, stages: Sequence[str]) -> float:
    return sum(row.get(f"{stage}_wall_s") or 0.0 for stage in stages)


def _cpu(row: Row, stages: Sequence[str]) -> float:
    return sum(row.get(f"{stage}_cpu_s") or 0.0 for stage in stages)


def _short(value: float, sign: str = "") -> str:
    return f"{value:{sign}.3f}".replace("0.", ".", 1)


def compare(batches: Sequence[Path], base: str | None = None, each: bool = False) -> list[str]:
    """A table of one batch, or of the differences between two, as lines of Markdown.

    Args:
        batches: One or two ``benchmark.json``, or folders that hold them.
        base: The configuration that others are compared with; None: the first.
        each: List the runs of one batch, without comparison.

    Raises:
        UserError: More than two files, a file that is no ``benchmark.json``, or an unknown
            configuration.
    """
    if len(batches) > 2:
        raise UserError(
            f"expected one or two benchmark.json files, found {len(batches)}",
            fix="compare them in pairs",
        )
    runs = [_read(path) for path in batches]
    if len(runs) == 2:
        return repeated(*runs)
    if each:
        return each_run(runs[0])
    configs = list(dict.fromkeys(row["config"] for row in runs[0]))
    base = configs[0] if base is None else base
    if base not in configs:
        meant = did_you_mean(nearest(base, configs))
        raise UserError(
            f"expected a configuration {base!r}, found {', '.join(configs)}{meant}",
            file=batches[0],
            fix="name one of them with --base",
        )
    return against(runs[0], base)


def _read(path: Path) -> list[Row]:
    check_exists(path, _FIX)
    path = path / "benchmark.json" if path.is_dir() else path
    try:
        runs = list(json.loads(read_bounded(path, _MAX_BYTES, fix=_FIX))["runs"])
        if not runs:
            raise ValueError("it has no runs")
        return runs
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise UserError(
            f"expected a benchmark.json: {error}",
            file=path,
            fix=_FIX,
        ) from None
