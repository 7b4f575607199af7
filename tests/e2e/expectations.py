"""What the tiny scene is expected to give, how far seeds scatter about it, and what differs.

    python -m tests.e2e.expectations            # measure, and compare with expected.json
    python -m tests.e2e.expectations --update   # measure, and store

Six seeds, each of which makes all of the scene anew from its pictures on: some five minutes on two
cores. Bits are no part of this: two machines may differ in the last one, and training makes of it
what another seed would. That two runs on one machine agree in every bit is tested by itself.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.runtime.counters import read_counters
from pipeline.splats.counters import InitCounters
from pipeline.training.loop.counters import TrainCounters
from tests.e2e.harness import TINY, TINY_DEMO, make_project, make_scene, snakemake

FILE = Path(__file__).with_name("expected.json")
UPDATE = "python -m tests.e2e.expectations --update"
SEEDS = range(6)
# Standard deviations over seeds that a change must exceed to be one.
DEVIATIONS = 3.0
# Name -> the least tolerance: another machine's rounding shows in what seeds hardly move.
MEASURED = {
    "psnr_db": 0.1,
    "train_psnr_db": 0.1,
    "ssim": 0.002,
    "gaussians": 1.0,
    "cloned": 100.0,
    "split": 100.0,
    "pruned": 100.0,
    "sparse_points": 30.0,
    "reprojection_error_px": 0.01,
    "rotation_error_deg": 0.02,
    "centre_error_share": 3e-4,
}
EXACT = ("stages", "registered_images", "total_images", "held_out_views", "steps")


def observe(project: Path, scene: str) -> dict[str, Any]:
    """What one finished run gave, by the names of ``MEASURED`` and ``EXACT``."""
    folder = project / "results" / scene
    found = json.loads((folder / "metrics.json").read_text())
    train = read_counters(folder / "train", TrainCounters)
    start = read_counters(folder / "init", InitCounters)
    return {
        "stages": sorted(name for name, s in found["stages"].items() if not s["skipped"]),
        "registered_images": found["registered_images"],
        "total_images": found["total_images"],
        "held_out_views": found["protocol"]["num_views"],
        "steps": train.steps,
        "psnr_db": found["psnr"],
        "train_psnr_db": found["train_psnr"],
        "ssim": found["ssim"],
        "gaussians": found["num_gaussians"],
        "cloned": train.changes.cloned,
        "split": train.changes.split,
        "pruned": train.changes.pruned,
        "sparse_points": start.points,
        "reprojection_error_px": found["reprojection_error_px"],
        "rotation_error_deg": found["pose_error"]["rotation_median_deg"],
        "centre_error_share": found["pose_error"]["centre_relative_median"],
    }


def differences(found: Mapping[str, Any], expected: Mapping[str, Any]) -> list[str]:
    """One sentence for each value that is not as stored: by how much, in which direction."""
    said = []
    for name in EXACT:
        if found[name] != expected["exact"][name]:
            said.append(f"{name}: {found[name]}, expected {expected['exact'][name]}")
    for name, stored in expected["measured"].items():
        change = found[name] - stored["expected"]
        if abs(change) > stored["tolerance"]:
            said.append(
                f"{name}: {found[name]:.6g} is {abs(change):.3g} "
                f"{'above' if change > 0 else 'below'} the expected {stored['expected']:.6g}; "
                f"seeds explain {stored['tolerance']:.3g}"
            )
    return said


def summarise(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The content of ``expected.json`` from one run a seed."""
    for name in EXACT:
        if any(run[name] != runs[0][name] for run in runs):
            raise SystemExit(f"{name} differs between seeds: {[run[name] for run in runs]}")
    measured = {}
    for name, least in MEASURED.items():
        values = [float(run[name]) for run in runs]
        tolerance = max(DEVIATIONS * statistics.stdev(values), least)
        measured[name] = {
            "expected": _short(statistics.mean(values)),
            "tolerance": _short(tolerance),
            # Whole: their scatter is a small difference of large numbers.
            "seeds": values,
        }
    return {
        "how": f"{UPDATE}: python -m pipeline.demo {' '.join(TINY_DEMO)}, config "
        f"{json.dumps(TINY)}, seeds {SEEDS[0]} to {SEEDS[-1]}; expected is their mean, tolerance "
        f"{DEVIATIONS:g} standard deviations or what another machine's rounding may do",
        "where": f"{platform.machine()}, {os.cpu_count()} cores, Python "
        f"{platform.python_version()}",
        "exact": {name: runs[0][name] for name in EXACT},
        "measured": measured,
    }


def _short(value: float) -> float:
    return float(f"{value:.5g}")


def measure() -> list[dict[str, Any]]:
    """One run of the tiny scene a seed."""
    runs = []
    with tempfile.TemporaryDirectory(prefix="expectations-") as folder:
        project = make_project(Path(folder) / "project")
        make_scene(project, "tiny")
        for seed in SEEDS:
            snakemake(project, "results/tiny/metrics.json", config=TINY | {"seed": seed})
            runs.append(observe(project, "tiny"))
            print(f"seed {seed}: {runs[-1]}", flush=True)
    return runs


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.e2e.expectations",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--update", action="store_true", help="store what was measured")
    update = parser.parse_args().update
    new = summarise(measure())
    if FILE.is_file():
        found = {name: stored["expected"] for name, stored in new["measured"].items()}
        said = differences(found | new["exact"], json.loads(FILE.read_text()))
        print("\n".join(said) or "as stored, within the tolerances")
    if update:
        FILE.write_text(json.dumps(new, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
