"""Measures time and pose error of structure from motion on scenes with known poses."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.sfm.measure import run_once
from benchmarks.sfm.scenes import configurations, load_scene
from benchmarks.sfm.summary import REFERENCE, Run, summaries, table
from pipeline.runtime.errors import UserError


def _arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.sfm",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("scenes", type=Path, nargs="+", help="scene folders with known poses")
    parser.add_argument(
        "--configs",
        nargs="+",
        default=[REFERENCE, "*"],
        metavar="PATTERN",
        help="preset/mapper/pairs, * matches anything; plan: the choices of the plan; "
        f"{REFERENCE}: its defaults",
    )
    parser.add_argument("--every", type=_positive, default=1, help="use every n-th photograph")
    parser.add_argument(
        "--repeats", type=_positive, default=1, help="runs of each configuration, in alternation"
    )
    parser.add_argument("--threads", type=_positive, default=1)
    add_record_options(parser)
    return parser.parse_args(arguments)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"expected a number from 1, found {text!r}")
    return int(text)


def main(arguments: Sequence[str] | None = None) -> int:
    args = _arguments(arguments)
    scenes = [load_scene(folder, args.every) for folder in args.scenes]
    runs: list[Run] = []
    for scene in scenes:
        count = len(scene.manifest.photos)
        print(f"{scene.name}: {count} photographs, measured against {scene.truth_kind}")
    print(f"{args.threads} threads, {args.repeats} runs of each")
    facts = measured("sfm", args.note, arguments) if args.json else None
    for _ in range(args.repeats):
        for scene in scenes:
            chosen = [*([None] if REFERENCE in args.configs else [])]
            for configuration in [*chosen, *configurations(scene, args.configs)]:
                run = run_once(scene, configuration, args.threads)
                runs.append(run)
                if facts is not None:  # A run takes minutes: finished ones are kept.
                    write_record(args.json, facts, runs)
                told = run.failure or f"{run.cpu_s:.1f} CPU s, {run.registered} images"
                print(f"{scene.name} {run.configuration}: {told}", file=sys.stderr, flush=True)
    if not runs:
        raise UserError(
            "no configuration matches: " + " ".join(args.configs),
            fix='for example --configs pycolmap plan "balanced/*"',
        )
    print(table(summaries(runs)), end="")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UserError as error:
        sys.exit(f"error: {error}")
