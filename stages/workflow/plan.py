"""Write a scene's plan.

Outputs: ``results/<scene>/plan.json`` and a picture of it, ``plan.svg``.
"""

import argparse
from pathlib import Path

from pipeline.plan.record import PlanRecord
from pipeline.reporting.dag import plan_svg
from pipeline.runtime.atomic import write_json, write_text
from pipeline.runtime.lock import logging_to
from stages.workflow.failures import reporting_errors

if __name__ == "__main__":
    parser = argparse.ArgumentParser("stages.workflow.plan", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--picture", type=Path, required=True)
    parser.add_argument("--plan", required=True, help="the plan as JSON")
    parser.add_argument("--log", type=Path, help="file that messages are also written to")
    args = parser.parse_args()
    plan = PlanRecord.model_validate_json(args.plan)
    with logging_to(args.log, plan.scene), reporting_errors(f"plan of {plan.scene}"):
        write_json(args.out, plan.model_dump(mode="json"))
        write_text(args.picture, plan_svg(plan))
