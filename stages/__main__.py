"""Run one stage: ``python -m stages STAGE``. This is the command of Snakemake's rules."""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from pathlib import Path

# The shell's convention: 128 and the number of the signal, SIGINT.
EXIT_INTERRUPTED = 130


def main() -> int:
    # Imported here, so that Ctrl-C meanwhile ends without a traceback.
    from pipeline.runtime.job import Request, run_stage
    from pipeline.runtime.machine import usable_cores
    from pipeline.runtime.memory import share_heap
    from stages.workflow.cluster import OVERHEAD_MB, granted_cpus

    parser = argparse.ArgumentParser("stages", description=__doc__)
    parser.add_argument("stage", help="name of the stage")
    parser.add_argument("--out", type=Path, required=True, help="the stage's folder")
    parser.add_argument("--key", required=True, help="the stage's key (canonical JSON)")
    parser.add_argument(
        "--input", nargs="*", default=[], metavar="ROLE=FOLDER", help="folders of finished stages"
    )
    parser.add_argument(
        "--publish", nargs="*", default=[], metavar="FILE=PATH", help="extra copies of outputs"
    )
    parser.add_argument("--threads", type=int, default=usable_cores(), help="native threads")
    parser.add_argument("--memory-mb", type=int, help="memory that the stage may use, in MB")
    parser.add_argument("--log", type=Path, help="file that messages are also written to")
    args = parser.parse_args()
    threads, memory_mb = max(1, args.threads), args.memory_mb
    if (granted := granted_cpus()) is not None:
        threads = min(threads, granted)
        memory_mb = memory_mb and max(1, memory_mb - OVERHEAD_MB)
    request = Request(
        stage=args.stage,
        key=json.loads(args.key),
        inputs=_pairs(args.input),
        out=args.out,
        threads=threads,
        memory_mb=memory_mb,
        log=args.log,
        publish=_pairs(args.publish),
    )
    share_heap()
    spec = importlib.import_module(f"stages.{args.stage}").SPEC
    return run_stage(request, spec.work, spec.counters)


def _pairs(items: list[str]) -> dict[str, Path]:
    return {name: Path(path) for name, _, path in (item.partition("=") for item in items)}


if __name__ == "__main__":
    try:
        code = main()
    except KeyboardInterrupt:  # While modules are imported.
        code = EXIT_INTERRUPTED
    sys.exit(code)
