"""Plans for tests: of a scan, and of a scene that needs every stage."""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.config import settled
from pipeline.config.schema import Config
from pipeline.plan import plan as plans
from pipeline.plan.record import PlanRecord
from pipeline.plan.scan import Scan
from pipeline.plan.values import Plan, SceneFacts, StagePlan
from stages.workflow.registry import STAGES

FACTS = SceneFacts(
    photographs=20,
    linear=0,
    alpha=0,
    masks=0,
    depths=0,
    gps=0,
    ground_control=False,
    gps_extent_m=0.0,
    focal_priors=20,
    turned_by_exif=0,
    bits=8,
    sizes={"640x480": 20},
    camera_groups={"640x480": 20},
    ordered=None,
    image_folder="images",
    view_size=(640, 480),
    training_memory_mb=1000,
    given_poses=None,
    truth=None,
    truth_digest=None,
    fingerprint="p",
)


BLOCK_STAGES = ("coarse", "partition", "block", "polish")
CHUNK_STAGES = ("extract", "pairs", "match")


def skipped(plan: Plan) -> list[str]:
    """The stages that the plan leaves out, but for those of large scenes and on demand."""
    rare = (*BLOCK_STAGES, *CHUNK_STAGES, "dense", "holes")
    return [n for n, stage in plan.stages.items() if not stage.run and n not in rare]


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
            inputs=sorted(set(plans._upstream(spec, running, config).values()))
            if name in running
            else [],
        )
        for name, spec in STAGES.items()
    }
    return Plan(
        scene=scene,
        stages=stages,
        warnings=[],
        config=settled_config(config),
        facts=FACTS,
        folder="folder",
    )


def settled_config(config: Config) -> settled.Config:
    """The options, with a settled default for each "auto"."""
    return settled.Config.model_validate(_without_auto(config.model_dump()))


def _without_auto(values: dict[str, Any]) -> dict[str, Any]:
    return {
        name: _without_auto(value) if isinstance(value, dict) else value
        for name, value in values.items()
        if value != "auto"
    }


def record_of(
    stages: Mapping[str, StagePlan], warnings: Sequence[str] = (), scene: str = "barn"
) -> PlanRecord:
    """A ``plan.json`` with these stages."""
    return PlanRecord(
        scene=scene, stages=dict(stages), order=list(stages), warnings=list(warnings), facts=FACTS
    )
