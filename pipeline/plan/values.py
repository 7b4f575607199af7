"""What a plan holds. ``pipeline.plan.plan`` makes it from the declarations of the stages."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict

from pipeline.config.schema import Config


class StagePlan(BaseModel):
    """Whether a stage runs for a scene, the reason, and decisions about its options."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    run: bool
    reason: str
    decisions: list[str] = []
    inputs: list[str] = []
    """The stages whose output it reads."""


class Plan(BaseModel):
    """The plan of a scene.

    Attributes:
        scene: name of the scene or run.
        stages: name -> plan of the stage, in the order of the DAG.
        config: the settled options.
        facts: facts about the scene that the plan depends on.
        folder: the scene folder, relative to the working directory or absolute.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: str
    stages: dict[str, StagePlan]
    warnings: list[str]
    config: Config
    facts: dict[str, Any]
    folder: str = ""

    def runs(self, stage: str) -> bool:
        return self.stages[stage].run
