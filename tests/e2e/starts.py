"""Two scenes that are started at once in one folder, many times.

``python -m tests.e2e.starts --pairs 100`` prints the starts that failed and ends with their number.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.e2e.harness import make_project, snakemake
from tests.pictures import photos

SCENES = ("garden", "patio")


def two_scenes(folder: Path) -> Path:
    """A project with two scenes of three photographs."""
    project = make_project(folder)
    for scene in SCENES:
        photos(project / "data" / scene / "images", 3)
    return project


def start_pairs(project: Path, pairs: int) -> list[str]:
    """Start both scenes at once, for a result that takes no time. Return what failed starts print.

    Every second pair also creates Snakemake's own folder at the same time.
    """
    failed = []
    for pair in range(pairs):
        shutil.rmtree(project / "results", ignore_errors=True)
        if pair % 2 == 0:
            shutil.rmtree(project / ".snakemake", ignore_errors=True)
        targets = [f"results/{scene}/plan.json" for scene in SCENES]
        with ThreadPoolExecutor(len(targets)) as pool:
            runs = pool.map(
                lambda target: snakemake(project, target, cores=1, check=False), targets
            )
        for target, run in zip(targets, runs, strict=True):
            if run.returncode or "Traceback" in run.stdout or not (project / target).exists():
                failed.append(f"pair {pair}, {target} ended with {run.returncode}:\n{run.stdout}")
    return failed


if __name__ == "__main__":
    parser = argparse.ArgumentParser("tests.e2e.starts", description=__doc__)
    parser.add_argument("--pairs", type=int, default=100)
    wanted = parser.parse_args().pairs
    with tempfile.TemporaryDirectory() as place:
        lost = start_pairs(two_scenes(Path(place) / "project"), wanted)
    print(*lost, f"{len(lost)} of {2 * wanted} starts failed", sep="\n")
    sys.exit(bool(lost))
