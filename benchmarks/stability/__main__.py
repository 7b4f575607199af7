"""Scenes at the edge of what numbers hold, through the whole pipeline.

    python -m benchmarks.stability                  # all cases: half an hour on two cores
    python -m benchmarks.stability posed scale_1e4  # these

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
import textwrap
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.stability.cases import CASES, Case, write_room

ROOT = Path(__file__).resolve().parents[2]
# A tenth of a decibel is what the rounding of another world may cost.
TOLERANCE_DB = 0.1
CONFIG: dict[str, Any] = {
    "views": {"max_long_side_px": 200},
    "train": {"steps": 300, "density": {"max_gaussians": 6000}},
    "experiments": {"train": {"gradient": {"stop_share": 0.0}}},
    "export": {"formats": ["ply", "spz", "splat", "gltf", "points", "colmap_text", "transforms"]},
}


@dataclass(frozen=True)
class Outcome:
    """What came of a case.

    Attributes:
        code: Snakemake's exit code.
        psnr, ssim: of held-out views; None where the run failed.
        gaussians: how many there were in the end.
        message: the error's, or the result's warnings.
        traceback: a program's error showed itself.
        right: as was expected.
    """

    case: str
    code: int
    psnr: float | None
    ssim: float | None
    gaussians: int | None
    message: str
    traceback: bool
    right: bool


def run(name: str, case: Case, work: Path, references: Mapping[str, Outcome]) -> Outcome:
    """Run one case in ``work``, which holds the room."""
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
        return Outcome(name, done.returncode, None, None, None, message, traceback, right)
    found = json.loads((work / "results" / name / "metrics.json").read_text())
    psnr = float(found["psnr"])
    reference = references.get(case.reference)
    right = case.expected != "error" and psnr >= case.least and not traceback
    if case.expected == "same" and name != case.reference:
        known = reference is not None and reference.psnr is not None
        right = known and abs(psnr - reference.psnr) <= TOLERANCE_DB  # type: ignore[union-attr,operator]
    told = "; ".join(found["warnings"])
    count = found["num_gaussians"]
    return Outcome(name, 0, psnr, found["ssim"], count, told, traceback, right)


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    result = dict(base)
    for key, value in over.items():
        deeper = isinstance(value, Mapping) and isinstance(result.get(key), Mapping)
        result[key] = _merged(result[key], value) if deeper else value
    return result


def _message(text: str) -> str:
    """The error that a user reads, on one line."""
    found = re.search(r"^error(?: in \w+ of \S+)?: (.*(?:\n  .*)*)", text, re.M)
    return " ".join(found[1].split()) if found else ""


def table(outcomes: list[Outcome]) -> str:
    """As Markdown."""
    lines = [
        "| case | what | PSNR (dB) | against | SSIM | Gaussians | |",
        "|---|---|---|---|---|---|---|",
    ]
    by_name = {outcome.case: outcome for outcome in outcomes}
    for o in outcomes:
        case = CASES[o.case]
        message = textwrap.shorten(o.message, 200, placeholder=" ...")
        if o.psnr is None:
            rest = f"| error | | | | {message} |"
        else:
            reference = by_name.get(case.reference)
            compared = case.expected == "same" and reference is not None and reference is not o
            against = ""
            if compared and reference is not None and reference.psnr is not None:
                against = f"{o.psnr - reference.psnr:+.3f} ({case.reference})"
            rest = f"| {o.psnr:.2f} | {against} | {o.ssim:.4f} | {o.gaussians} | {message} |"
        wrong = "" if o.right else " **WRONG**"
        lines.append(f"| {o.case}{wrong} | {case.what} {rest}")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.stability",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(CASES)}")
    parser.add_argument("--work", type=Path, help="an empty folder to work in and to keep")
    parser.add_argument("--json", type=Path, help="write what came of the cases here")
    args = parser.parse_args()
    unknown = set(args.cases) - CASES.keys()
    if unknown:
        parser.error(f"no such case: {', '.join(sorted(unknown))}")
    wanted = set(args.cases or CASES)
    # What they are compared with is run, too.
    wanted |= {CASES[name].reference for name in wanted if CASES[name].expected == "same"}
    outcomes: dict[str, Outcome] = {}
    with tempfile.TemporaryDirectory(prefix="stability-") as temporary:
        work = (args.work or Path(temporary)).resolve()
        write_room(work / "room")
        for name in (name for name in CASES if name in wanted):
            outcomes[name] = run(name, CASES[name], work, outcomes)
            print(outcomes[name], flush=True)
    found = list(outcomes.values())
    if args.json:
        args.json.write_text(json.dumps([asdict(o) for o in found], indent=1))
    wrong = [o.case for o in found if not o.right]
    print(f"\n{table(found)}\n\n{len(found)} cases, wrong: {', '.join(wrong) or 'none'}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
