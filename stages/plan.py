"""Write the plan that the DAG was built from. Output: ``results/<scene>/plan.json``."""

import argparse
import json
from pathlib import Path

from pipeline.runtime.atomic import write_json

if __name__ == "__main__":
    parser = argparse.ArgumentParser("stages.plan", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--plan", required=True, help="the plan as JSON")
    args = parser.parse_args()
    write_json(args.out, json.loads(args.plan))
