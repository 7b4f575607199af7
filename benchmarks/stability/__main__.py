"""Runs the whole pipeline on numerically extreme scenes.

    python -m benchmarks.stability                  # all cases: half an hour on two cores
    python -m benchmarks.stability posed scale_1e4  # selected ones

Each case either gives the quality it should or ends with one clear message; the exit code is 1 if
one does neither.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks import record_tables
from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.results import StabilityResult
from benchmarks.stability.cases import CASES, Case, write_room

ROOT = Path(__file__).resolve().parents[2]
# The difference in PSNR that rounding in another world frame may cause.
TOLERANCE_DB = 0.1
CONFIG: dict[str, Any] = {
    "views": {"max_long_side_px": 200},
    "train": {"steps": 300, "density": {"max_gaussians": 6000}},
    "experiments": {"train": {"gradient": {"stop_share": 0.0}}},
    "export": {"formats": ["ply", "spz", "splat", "gltf", "points", "colmap_text", "transforms"]},
}


def run(
    name: str, case: Case, work: Path, references: Mapping[str, StabilityResult]
) -> StabilityResult:
    """Run one case in ``work``, which contains the base scene."""
    folder = work / "data" / name
    folder.mkdir(parents=True)
    case.make(folder, work / "room")
    config = _merged(CONFIG, case.config)
    done = subprocess.run(
        [
            *(sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile")),
            *("--directory", str(work), "--cores", "2", f"results/{name}/metrics.json"),
            *("--config", *(f"{key}={json.dumps(value)}" for key, value in config.items())),
        ],
        cwd=work,
        env=os.environ | {"NO_COLOR": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    (work / f"{name}.log").write_text(done.stdout)
    traceback = "Traceback" in done.stdout
    if done.returncode:
        message = _message(done.stdout)
        right = case.expected == "error" and not traceback and bool(message)
        return StabilityResult(
            case=name,
            what=case.what,
            code=done.returncode,
            psnr=None,
            ssim=None,
            reference=None,
            difference_db=None,
            gaussians=None,
            message=message,
            traceback=traceback,
            right=right,
        )
    found = json.loads((work / "results" / name / "metrics.json").read_text())
    psnr = float(found["psnr"])
    right = case.expected != "error" and psnr >= case.least and not traceback
    compared = case.expected == "same" and name != case.reference
    difference = None
    if compared:
        reference = references[case.reference].psnr
        difference = None if reference is None else psnr - reference
        right &= difference is not None and abs(difference) <= TOLERANCE_DB
    return StabilityResult(
        case=name,
        what=case.what,
        code=0,
        psnr=psnr,
        ssim=found["ssim"],
        reference=case.reference if compared else None,
        difference_db=difference,
        gaussians=found["num_gaussians"],
        message="; ".join(found["warnings"]),
        traceback=traceback,
        right=right,
    )


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    result = dict(base)
    for key, value in over.items():
        deeper = isinstance(value, Mapping) and isinstance(result.get(key), Mapping)
        result[key] = _merged(result[key], value) if deeper else value
    return result


def _message(text: str) -> str:
    """The error message for the user, on one line."""
    found = re.search(r"^error(?: in \w+ of \S+)?: (.*(?:\n  .*)*)", text, re.M)
    return " ".join(found[1].split()) if found else ""


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.stability",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(CASES)}")
    parser.add_argument("--work", type=Path, help="an empty folder for the runs, which is kept")
    add_record_options(parser)
    args = parser.parse_args()
    unknown = set(args.cases) - CASES.keys()
    if unknown:
        parser.error(f"no such case: {', '.join(sorted(unknown))}")
    wanted = set(args.cases or CASES)
    # The references of the cases are run as well.
    wanted |= {CASES[name].reference for name in wanted if CASES[name].expected == "same"}
    outcomes: dict[str, StabilityResult] = {}
    with tempfile.TemporaryDirectory(prefix="stability-") as temporary:
        work = (args.work or Path(temporary)).resolve()
        write_room(work / "room")
        for name in (name for name in CASES if name in wanted):
            outcomes[name] = run(name, CASES[name], work, outcomes)
            print(outcomes[name], flush=True)
    found = list(outcomes.values())
    if args.json:
        write_record(args.json, measured("stability", args.note), found)
    wrong = [o.case for o in found if not o.right]
    print(f"\n{record_tables.outcomes(found)}")
    print(f"{len(found)} cases, wrong: {', '.join(wrong) or 'none'}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
