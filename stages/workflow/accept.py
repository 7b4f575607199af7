"""Judge a run's result by rules, and write ``results/<scene>/accepted.json`` if it meets them."""

import argparse
import sys
from pathlib import Path

from pipeline.reporting.acceptance.command import Criteria
from pipeline.reporting.acceptance.judge import judge, table
from pipeline.reporting.acceptance.measured import measured_in
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import EXIT_NOT_ACCEPTED
from pipeline.runtime.lock import logging_to
from stages.workflow.failures import reporting_errors

if __name__ == "__main__":
    parser = argparse.ArgumentParser("stages.workflow.accept", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--criteria", required=True, help="rules and baseline as JSON")
    parser.add_argument("--log", type=Path, help="file that messages are also written to")
    args = parser.parse_args()
    folder, criteria = args.out.parent, Criteria.model_validate_json(args.criteria)
    with logging_to(args.log, folder.name), reporting_errors(f"accept of {folder.name}"):
        judged = judge(criteria.rules, measured_in(folder), criteria.baseline)
        print("\n".join(table(judged)), file=sys.stderr)
        if not judged.accepted:
            print(f"error in accept of {folder.name}: {judged.badge}", file=sys.stderr, flush=True)
            sys.exit(EXIT_NOT_ACCEPTED)
        write_json(args.out, judged.model_dump(mode="json"))
