"""``python -m benchmarks.georeference``: what the program makes of GPS and ground control points
that are few, narrow, incomplete or wrong, in synthetic surveys whose true frame is known.

A case is right if the frame is close to the truth, refused if there is an error or a level frame
with its reason, stated if the frame is farther off but the standard deviations in the message
explain the error, and warned if a warning does. Everything else is silently wrong.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter

import numpy as np

from benchmarks.georeference.verdict import judged
from benchmarks.measured import add_record_options, measured, write_record


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.georeference",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--seeds", type=int, default=3, help="surveys of each case")
    add_record_options(parser)
    args = parser.parse_args()
    results = [result for seed in range(args.seeds) for result in judged(seed)]
    for result in sorted(results, key=lambda result: (result.verdict, result.case)):
        print(f"{result.verdict:15} {result.case} (seed {result.seed}): {result.said[:160]}")
    counts = Counter(result.verdict for result in results)
    print(", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items())))
    if args.json:
        write_record(args.json, measured("georeference", args.note), results)
    return int(any(result.verdict == "silently wrong" for result in results))


if __name__ == "__main__":
    np.seterr(all="ignore")
    sys.exit(main())
