"""Plans for tests: of a scan, and of a scene that needs every stage."""

from pipeline.config.schema import Config
from pipeline.plan import plan as plans
from pipeline.plan.scan import Scan
from pipeline.plan.values import Plan, StagePlan
from stages.workflow.registry import STAGES


def make_plan(scan: Scan, config: Config, folder: str = "") -> Plan:
    return plans.make_plan(scan, config, STAGES, folder)


def full_plan(config: Config, scene: str = "fox", skipped: tuple[str, ...] = ()) -> Plan:
    """All stages but the ``skipped`` ones run; the reasons need escaping in HTML."""
    running = set(STAGES) - set(skipped)
    stages = {
        name: StagePlan(
            run=name in running,
            reason=f"why {name} <&",
            decisions=["so"],
            inputs=sorted(set(plans._upstream(spec, running).values())) if name in running else [],
        )
        for name, spec in STAGES.items()
    }
    facts = {"truth_digest": None, "fingerprint": "p", "training_memory_mb": 1000}
    return Plan(
        scene=scene, stages=stages, warnings=[], config=config, facts=facts, folder="folder"
    )
