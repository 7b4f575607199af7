"""Stores what a scene's runs measured, for the tables of the docs.

    python -m benchmarks.record results/fox -o benchmarks/records/fox-fast-x86-64-v3.json \\
        --command "snakemake --cores 2 results/fox/metrics.json --config preset=fast"

Several folders are runs of one scene under several seeds. Everything else comes from metrics.json
and the stages' run.json: commit, machine, instruction set, compiler, protocol, seeds.
``benchmarks.tables`` writes the tables.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import EXIT_USER_ERROR

# The stages that find the poses and make the training images.
POSES = (
    *("decode", "extract", "features", "pairs", "match", "matches", "sfm"),
    *("refine", "undistort"),
)
PROTOCOL = (
    "num_views",
    "resolution",
    "split",
    "background",
    "exposure",
    "appearance",
    "masks",
    "poses",
    "published",
)
# The runs of a record agree in these facts: they are of one machine and build.
SAME = ("commit", "processor", "cores", "memory_mb", "instruction_set", "compiler", "threads")


class NotComparable(ValueError):
    """Runs that one record cannot hold."""


def scene_record(
    folders: Sequence[Path], command: str, note: str = "", training: str = ""
) -> dict[str, Any]:
    """The record of runs of one scene, as it is stored.

    Args:
        training: The preset, or what else names the training in tables.

    Raises:
        NotComparable: The runs are of several scenes, commits, machines or protocols.
        OSError, KeyError: A folder is not a finished scene.
    """
    every = [_run(folder) for folder in folders]
    first = every[0]
    for other in every[1:]:
        for key in ("scene", "where", "protocol", "photographs"):
            if other[key] != first[key]:
                raise NotComparable(f"{key} differs: {first[key]} and {other[key]}")
    return {
        "kind": "scene",
        "scene": first["scene"],
        "photographs": first["photographs"],
        "command": command,
        "note": note,
        "date": date.today().isoformat(),
        "training": training,
        **first["where"],
        "protocol": first["protocol"],
        "runs": sorted((run["measured"] for run in every), key=lambda run: run["seed"]),
    }


def _run(folder: Path) -> dict[str, Any]:
    metrics = json.loads((folder / "metrics.json").read_text())
    trained = json.loads((folder / "train" / "run.json").read_text())
    times = {
        path.parent.name: json.loads(path.read_text()) for path in sorted(folder.glob("*/run.json"))
    }
    error = metrics["pose_error"]
    measured = {
        "seed": metrics["seed"],
        "psnr": metrics["psnr"],
        "ssim": metrics["ssim"],
        "flip": metrics.get("flip"),
        "lpips": metrics["lpips"],
        "train_psnr": metrics["train_psnr"],
        "gaussians": metrics["num_gaussians"],
        "registered": metrics["registered_images"],
        "pose_error": None if error is None else _numbers(error),
        "cpu_s": {name: run["cpu_s"] for name, run in times.items()},
        "wall_s": {name: run["wall_s"] for name, run in times.items()},
        "peak_mb": max(run["peak_rss_mb"] for run in times.values()),
        "load_average": trained["load_average"],
    }
    return {
        "scene": metrics["scene"].split("@")[0],
        "photographs": metrics["total_images"],
        "where": {key: trained[key] for key in SAME},
        "protocol": {key: metrics["protocol"].get(key) for key in PROTOCOL},
        "measured": measured,
    }


def _numbers(values: dict[str, Any]) -> dict[str, float]:
    return {key: value for key, value in values.items() if isinstance(value, int | float)}


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.record", description="Stores what a scene's runs measured."
    )
    parser.add_argument("folders", type=Path, nargs="+", metavar="results/NAME")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FILE")
    parser.add_argument("--command", required=True, help="the command that made them")
    parser.add_argument("--note", default="", help="what else was running, for example")
    parser.add_argument("--training", default="", help="its name in tables: preset fast")
    options = parser.parse_args()
    try:
        record = scene_record(options.folders, options.command, options.note, options.training)
    except (OSError, KeyError, ValueError) as error:
        print(
            f"error: expected finished scenes (results/NAME): {error!r}",
            file=sys.stderr,
        )
        return EXIT_USER_ERROR
    write_json(options.out, record)
    return 0


if __name__ == "__main__":
    sys.exit(main())
