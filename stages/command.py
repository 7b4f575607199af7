"""The command line that every stage shares: ``python -m stages.<stage>``.

Snakemake calls it; by hand it is seldom needed. ``--help`` says what the arguments are.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from pipeline.runtime.job import Job, Request, run_stage
from pipeline.runtime.machine import usable_cores


def main(stage: str, work: Callable[[Job], None], description: str | None) -> NoReturn:
    """Parse the command line, run ``work`` as ``stage`` and exit with its code."""
    parser = argparse.ArgumentParser(f"stages.{stage}", description=description)
    parser.add_argument("--out", type=Path, required=True, help="the stage's folder")
    parser.add_argument("--key", required=True, help="the stage's key (canonical JSON)")
    parser.add_argument(
        "--input", nargs="*", default=[], metavar="ROLE=FOLDER", help="folders of finished stages"
    )
    parser.add_argument(
        "--publish", nargs="*", default=[], metavar="FILE=PATH", help="extra copies of outputs"
    )
    parser.add_argument("--threads", type=int, default=usable_cores())
    parser.add_argument("--log", type=Path, help="also write messages here")
    args = parser.parse_args()
    request = Request(
        stage=stage,
        key=json.loads(args.key),
        inputs=_pairs(args.input),
        out=args.out,
        threads=max(1, args.threads),
        log=args.log,
        publish=_pairs(args.publish),
    )
    sys.exit(run_stage(request, work))


def _pairs(items: list[str]) -> dict[str, Path]:
    return {name: Path(path) for name, _, path in (item.partition("=") for item in items)}
