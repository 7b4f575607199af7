"""The declaration of a stage, from which its rule, its key and its line in the plan follow."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict

if TYPE_CHECKING:
    from pipeline.plan.plan import Plan
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled
    from pipeline.runtime.job import Job


class StagePlan(BaseModel):
    """Whether a stage runs for a scene, why, and what was settled for it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    run: bool
    reason: str
    decisions: list[str] = []
    inputs: list[str] = []
    """Stages whose output it reads."""


_POSE_KINDS = {"colmap": "COLMAP model", "transforms": "transforms", "llff": "LLFF poses"}


def unless_posed(scan: Scan, reason: str, decisions: list[str]) -> StagePlan:
    """The plan of a stage that a scene needs only where no poses are given."""
    poses = scan.poses
    if poses is None:
        return StagePlan(run=True, reason=reason, decisions=decisions)
    where = "transforms*.json" if poses.path == "." else poses.path
    given = f"poses are given: {_POSE_KINDS[poses.kind]} {where}, {poses.num_images} cameras"
    return StagePlan(run=False, reason=given)


def _none(plan: Plan) -> dict[str, Any]:
    return {}


@dataclass(frozen=True)
class StageSpec:
    """A stage as ``stages/<name>.py`` declares it.

    Attributes:
        name: of the rule, of the module in ``stages/`` and of the folder in ``results/<scene>/``.
        work: does the work in ``Job.out``. Heavy imports belong inside it: the Snakefile imports
            every declaration.
        decide: whether a scene needs the stage, and why. Pure.
        inputs: role -> the stages that can fill it; the first that the plan runs does.
        options: dotted paths of the options or sections that the stage reads; no other can be
            read (see ``pipeline.config.options``).
        packages: those whose version decides the result.
        seeded: whether the stage draws random numbers. The seed is in the keys of these only, so
            that runs with other seeds share the other stages' work.
        memory_mb: what a cluster reserves, MB; a function where it depends on the plan.
        publishes: outputs that are copied to ``results/<scene>/``, and their captions in
            Snakemake's report.
        shows_plan: whether the stage reads the plan (``Job.key["plan"]``: that of plan.json).
        facts: what else decides the result, beside code, options, packages, seed and inputs.
    """

    name: str
    work: Callable[[Job], None]
    decide: Callable[[Scan, Settled], StagePlan]
    inputs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    options: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()
    seeded: bool = False
    memory_mb: int | Callable[[Plan], int] = 2000
    publishes: Mapping[str, str] = field(default_factory=dict)
    shows_plan: bool = False
    facts: Callable[[Plan], dict[str, Any]] = _none

    @property
    def module(self) -> str:
        return f"stages.{self.name}"
