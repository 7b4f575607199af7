"""The runs of a batch, what its configurations are worth, or how well a second batch repeats it.

    python -m benchmarks.compare results/benchmark.json --each
    python -m benchmarks.compare results/benchmark.json --base balanced
    python -m benchmarks.compare first/benchmark.json results/benchmark.json

prints the table as Markdown. ``config/ablations.yaml`` and ``config/skipping.yaml`` make batches
that are worth comparing.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.config.schema import Config
from pipeline.runtime.job import EXIT_USER_ERROR

# The same run on the same machine gives these to the bit.
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
# Stages in which a choice of the plan shows; the others' time goes with them.
POSES = ("decode", "features", "matches", "sfm", "undistort")

Row = dict[str, Any]


def each(rows: Sequence[Row]) -> list[str]:
    """Each run for itself: quality, and wall seconds by stage."""
    lines = [
        "| run | PSNR | on training views | SSIM | Gaussians | posed | rotation, centres | poses s "
        "| training s | in all s | most MB | |",
        "|---" * 12 + "|",
    ]
    for row in rows:
        name = f"{row['scene']}@{row['config']}"
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
    """Each configuration beside ``base``, scene by scene and in the mean: the difference of PSNR
    (dB) and SSIM, CPU seconds for the poses and of training, and Gaussians."""
    by_run: dict[tuple[str, str], Row] = {}
    for row in rows:
        by_run.setdefault((row["scene"], row["config"]), row)
    configs = list(dict.fromkeys(row["config"] for row in rows))
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    head = "| | " + " | ".join(scenes) + " | mean | CPU s: poses, training | Gaussians |"
    lines = [head, "|---" * (len(scenes) + 4) + "|"]
    for config in configs:
        cells: list[str] = []
        gains: list[float] = []
        kept: list[Row] = []
        for scene in scenes:
            found, other = by_run.get((scene, config)), by_run.get((scene, base))
            if found is None or found["status"] != "ok":
                state = "no run" if found is None else f"{found['status']}: {found['message']}"
                cells.append(state)
                continue
            row = found
            kept.append(row)
            if config == base or other is None or other["psnr"] is None:
                cells.append(f"{row['psnr']:.2f} dB, {_short(row['ssim'])}")
                continue
            gains.append(row["psnr"] - other["psnr"])
            cells.append(f"{gains[-1]:+.2f}, {_short(row['ssim'] - other['ssim'], '+')}")
        mean = f"{statistics.fmean(gains):+.2f} dB" if gains else ""
        cost = gaussians = ""
        if kept:
            poses = statistics.fmean(_cpu(row, POSES) for row in kept)
            training = statistics.fmean(_cpu(row, ("train",)) for row in kept)
            cost = f"{poses:.0f}, {training:.0f}"
            gaussians = f"{statistics.fmean(row['num_gaussians'] for row in kept) / 1e3:.0f}k"
        name = f"**{config}**" if config == base else config
        lines.append(f"| {name} | {' | '.join(cells)} | {mean} | {cost} | {gaussians} |")
    return lines


def repeated(first: Sequence[Row], second: Sequence[Row]) -> list[str]:
    """What two batches of the same runs agree in: quality to the bit, and the ratio of times."""
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
            # What was taken over from another run has that run's time.
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
    return sum(row[f"{stage}_wall_s"] or 0.0 for stage in stages)


def _cpu(row: Row, stages: Sequence[str]) -> float:
    return sum(row[f"{stage}_cpu_s"] or 0.0 for stage in stages)


def _short(value: float, sign: str = "") -> str:
    return f"{value:{sign}.3f}".replace("0.", ".", 1)


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.compare", description="Tables of benchmark.json files."
    )
    parser.add_argument("batches", type=Path, nargs="+", metavar="benchmark.json")
    parser.add_argument(
        "--base",
        default=Config().preset,
        metavar="CONFIG",
        help="what the others are beside (default: %(default)s)",
    )
    parser.add_argument(
        "--each", action="store_true", help="each run of one batch, without comparing"
    )
    options = parser.parse_args()
    if len(options.batches) > 2:
        parser.error("expected one file, or two to compare")
    batches = []
    for path in options.batches:
        try:
            batches.append(json.loads(path.read_text())["runs"])
        except (OSError, ValueError, KeyError) as error:
            print(f"error: {path}: expected a batch's benchmark.json: {error}", file=sys.stderr)
            return EXIT_USER_ERROR
    if options.each and len(batches) == 1:
        print("\n".join(each(batches[0])))
        return 0
    if len(batches) == 1 and options.base not in {row["config"] for row in batches[0]}:
        print(f"error: {options.batches[0]}: no configuration {options.base}", file=sys.stderr)
        return EXIT_USER_ERROR
    lines = repeated(*batches) if len(batches) == 2 else against(batches[0], options.base)
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
