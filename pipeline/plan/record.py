"""``plan.json``: the plan of a scene as stages, pages and tables read it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from pipeline.plan.values import SceneFacts, StagePlan
from pipeline.runtime.record import read_record, rerun

NAME = "plan.json"


class PlanRecord(BaseModel):
    """``plan.json``: which stages a scene needs, and why."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    version: Literal[1] = Field(1, description="Version of this file's format.")
    scene: str = Field(description="The run's name: a scene, alone or with configuration and seed.")
    stages: dict[str, StagePlan] = Field(description="Stage to its plan.")
    order: list[str] = Field(description="The stages in the order of the DAG.")
    warnings: list[str] = Field(description="What the user should know before the stages run.")
    facts: SceneFacts = Field(description="The facts about the scene that the plan depends on.")

    def runs(self, stage: str) -> bool:
        return stage in self.stages and self.stages[stage].run

    @model_validator(mode="after")
    def _order_has_every_stage(self) -> Self:
        if sorted(self.order) != sorted(self.stages):
            raise ValueError("order does not name each of stages once")
        return self


def read_plan(folder: Path) -> PlanRecord:
    """The plan of a finished scene's folder (``results/<scene>``).

    Raises:
        UserError: The file is missing, damaged or from another version of the program.
    """
    # The rule that writes it is named "plan", as if it were a stage.
    return read_record(folder / NAME, PlanRecord, fix=rerun(folder / "plan"))
