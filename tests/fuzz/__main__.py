"""Fuzz the readers, and print the counts and findings: ``python -m tests.fuzz --cases N``."""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.fuzz.campaign import Outcome, as_json, content, run, run_apart
from tests.fuzz.readers import READERS

# A process runs this many cases of a reader; a crash loses the counts of its process.
BATCH = 5000


def main() -> int:
    parser = argparse.ArgumentParser("tests.fuzz", description=__doc__)
    parser.add_argument("readers", nargs="*", metavar="READER", help="(default: all)")
    parser.add_argument("--cases", type=int, default=20_000, help="of all readers together")
    parser.add_argument("--first", type=int, default=0, help="number of each reader's first case")
    parser.add_argument("--processes", type=int, default=1, help="(default: %(default)s)")
    parser.add_argument(
        "--write", type=Path, metavar="FOLDER", help="write the files of the case --first instead"
    )
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    names = args.readers or list(READERS)
    if unknown := set(names) - READERS.keys():
        parser.error(f"no reader {min(unknown)}; there are {', '.join(READERS)}")
    if args.worker is not None:
        print(as_json(run(names[0], range(args.first, args.first + args.cases), args.worker)))
        return 0
    if args.write is not None:
        reader = READERS[names[0]]
        args.write.mkdir(parents=True, exist_ok=True)
        for name, data in content(names[0], reader, list(reader.seeds()), args.first).items():
            (args.write / name).write_bytes(data)
        return 0
    return campaign(names, args.first, args.cases, args.processes)


def campaign(names: list[str], first: int, cases: int, processes: int) -> int:
    """Run and print; returns 1 if there are findings."""
    total = sum(READERS[name].weight for name in names)
    jobs = [
        (name, range(start, min(start + BATCH, stop)))
        for name in names
        for stop in [first + max(1, round(cases * READERS[name].weight / total))]
        for start in range(first, stop, BATCH)
    ]
    jobs.sort(key=lambda job: job[1].start)  # All readers in turn.
    outcomes = {name: Outcome() for name in names}
    start = time.monotonic()
    with ThreadPoolExecutor(processes) as pool:
        for (name, _), outcome in zip(
            jobs, pool.map(lambda job: run_apart(*job), jobs), strict=True
        ):
            for what, case in outcome.findings.items():
                if what not in outcomes[name].findings:
                    print(f"finding: {name} case {case}: {what}", flush=True)
            outcomes[name].add(outcome)
            done = sum(outcome.cases for outcome in outcomes.values())
            print(f"{done} cases after {time.monotonic() - start:.0f} s", flush=True)
    for name, outcome in outcomes.items():
        refused = outcome.cases - outcome.read
        print(f"{name:20} {outcome.cases:8} cases, {outcome.read} read, {refused} refused")
    found = sum(len(outcome.findings) for outcome in outcomes.values())
    done = sum(outcome.cases for outcome in outcomes.values())
    print(f"{done} cases in {time.monotonic() - start:.0f} s, {found} findings")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
