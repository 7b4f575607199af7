"""Truth, verdict and evidence of every case, and a confusion table."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import record_tables
from benchmarks.judge.cases import CASES, make
from benchmarks.judge.look_alikes import LOOK_ALIKES, write_look_alikes
from benchmarks.judge.pictures import PICTURES, Matched, match_folder, write_pictures
from benchmarks.judge.truth import Truth, grade
from benchmarks.judge.world import write
from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.results import JudgeResult
from pipeline.config.settled import Sfm
from pipeline.io.colmap import read_model
from pipeline.runtime.isolate import run_isolated
from pipeline.sfm.attempts import MAX_ATTEMPTS, Attempt, map_until_good
from pipeline.sfm.mappers import Mapper
from pipeline.sfm.models import quiet_colmap, write_model

# The printed fields of the evidence: name, heading, format.
SHOWN = (
    ("explained_matches", "expl", "{:.2f}"),
    ("agreeing_pairs", "agree", "{:.2f}"),
    ("agreeing_distinctive", "dist", "{:.2f}"),
    ("broken_steps", "brk", "{:.0f}"),
    ("missing_covisibility", "miss", "{:.2f}"),
    ("observations_per_image", "obs", "{:.0f}"),
    ("parallax", "parlx", "{:.4f}"),
    ("median_angle_deg", "angle", "{:.1f}"),
    ("focal_certainty", "fcert", "{:.2f}"),
    ("focal_off", "foff", "{:.2f}"),
)


ALL_CASES = (*CASES, *PICTURES, *LOOK_ALIKES)


def run_made(name: str, seed: int, mapper: Mapper, budget: int, folder: Path) -> JudgeResult:
    """Run a case of ``cases.CASES``."""
    made = write(make(name, seed), folder / "database.db", seed)
    start = time.process_time()
    total = len(made.manifest.photos)
    best, records = map_until_good(
        folder / "database.db", mapper, total, Sfm().min_registered_share, seed, budget
    )
    truth = grade(_model(best, folder), made.truths, total, made.depth)
    return _row(name, seed, truth, best, total, len(records), time.process_time() - start)


def run_folder(
    name: str, seed: int, found: Matched, mapper: Mapper | None, budget: int
) -> JudgeResult:
    """Match and map a folder of photographs by the plan of the pipeline."""
    start = time.process_time()
    best, records = map_until_good(
        found.database,
        mapper or found.mapper,
        found.total,
        found.min_share,
        seed,
        budget,
        found.steps,
    )
    truth = None
    if found.truth is not None:
        model = _model(best, found.database.parent)
        truth = grade(model, [read_model(found.truth)], found.total, None)
    return _row(name, seed, truth, best, found.total, len(records), time.process_time() - start)


def _model(best: Attempt, folder: Path) -> Any:
    if not best.models:
        return None
    write_model(best.models[0], folder / "model")
    return read_model(folder / "model")


def _row(
    name: str, seed: int, truth: Truth | None, best: Attempt, total: int, tried: int, cpu: float
) -> JudgeResult:
    evidence = best.evidence.model_dump() if best.evidence else {}
    return JudgeResult(
        name,
        seed,
        truth,
        best.verdict.grade,
        best.verdict.reasons,
        evidence.get("registered", 0),
        total,
        tried,
        round(cpu, 1),
        {key: _finite(value) for key, value in evidence.items()},
    )


def rows(args: argparse.Namespace) -> Iterator[JudgeResult]:
    names = [*CASES, *PICTURES, *LOOK_ALIKES] if args.cases is None else args.cases
    for seed in args.seeds:
        for name in names:
            with tempfile.TemporaryDirectory(prefix="judge-") as temporary:
                folder = Path(temporary)
                if name in CASES:
                    yield run_made(name, seed, args.mapper, args.budget, folder)
                else:
                    render = write_pictures if name in PICTURES else write_look_alikes
                    run_isolated(render, name, seed, folder / name)
                    found = match_folder(folder / name, folder, seed)
                    yield run_folder(name, seed, found, args.mapper, args.budget)
    for photographs in args.data:
        with tempfile.TemporaryDirectory(prefix="judge-") as temporary:
            found = match_folder(photographs, Path(temporary), args.seeds[0])
            yield run_folder(photographs.name, args.seeds[0], found, None, args.budget)


def show(row: JudgeResult) -> str:
    truth = "?" if row.truth is None else row.truth.grade
    facts = " ".join(
        f"{short} {form.format(row.evidence[key])}"
        for key, short, form in SHOWN
        if row.evidence.get(key) is not None
    )
    wrong = "  <-- WRONG" if row.wrong else ""
    share = "" if row.truth is None else f" {row.truth.share:.2f}"
    return (
        f"{row.case:<22} {row.seed:>2}  truth {truth:<6}{share}  verdict {row.verdict:<6} "
        f"{row.registered:>3}/{row.total:<3} {row.attempts} tried {row.cpu_s:>6.1f} s  {facts}"
        f"{'  | ' + '; '.join(row.reasons) if row.reasons else ''}{wrong}"
    )


def _seeds(text: str) -> list[int]:
    first, _, last = text.partition("-")
    return list(range(int(first), int(last or first) + 1))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.judge", description=__doc__)
    parser.add_argument("--cases", nargs="*", help=f"of {', '.join(ALL_CASES)}")
    parser.add_argument("--seeds", type=_seeds, default=[0], help="one, or first-last")
    parser.add_argument(
        "--data", nargs="*", type=Path, default=[], help="scenes' folders, or results/NAME"
    )
    parser.add_argument("--mapper", choices=["incremental", "global"], default="incremental")
    parser.add_argument(
        "--budget", type=int, default=MAX_ATTEMPTS, help="largest number of attempts"
    )
    add_record_options(parser)
    args = parser.parse_args()
    unknown = set(args.cases or []) - set(ALL_CASES)
    if unknown:
        parser.error(f"no such case: {', '.join(sorted(unknown))}")
    quiet_colmap()
    found = []
    for row in rows(args):
        found.append(row)
        print(show(row), flush=True)
    print("\n" + record_tables.verdicts(found), end="")
    if args.json:
        write_record(args.json, measured("judge", args.note), found)
    wrong = sum(row.wrong for row in found)
    print(f"\n{len(found)} cases, {wrong} wrong")
    return 1 if wrong else 0


def _finite(value: Any) -> float | None:
    """A number of the evidence as a Python float; None where it is missing or not finite."""
    if value is None or not np.isfinite(value):
        return None
    return float(value)


if __name__ == "__main__":
    sys.exit(main())
