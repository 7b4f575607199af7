"""Write a scene's plan.

Outputs: ``results/<scene>/plan.json`` and a picture of it, ``plan.svg``.
"""

import argparse
import json
from pathlib import Path

from pipeline.reporting.dag import plan_svg
from pipeline.runtime.atomic import write_json, write_text

if __name__ == "__main__":
    parser = argparse.ArgumentParser("stages.workflow.plan", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--picture", type=Path, required=True)
    parser.add_argument("--plan", required=True, help="the plan as JSON")
    args = parser.parse_args()
    plan = json.loads(args.plan)
    write_json(args.out, plan)
    write_text(args.picture, plan_svg(plan))
