"""The declaration of a stage, from which its Snakemake rule, key and plan are made."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pipeline.plan.values import Plan, StagePlan
from pipeline.runtime.counters import NoCounters, StageCounters

if TYPE_CHECKING:
    from pipeline.config.schema import Config
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled
    from pipeline.runtime.job import Job


def unless_posed(scan: Scan, reason: str, decisions: list[str]) -> StagePlan:
    """The plan of a stage that runs only if no poses are given."""
    poses = scan.poses
    if poses is None:
        return StagePlan(run=True, reason=reason, decisions=decisions)
    return StagePlan(run=False, reason=f"poses are given: {poses.label}")


def if_several_jobs(
    scan: Scan, settled: Settled, reason: str, *, scattered: bool = False
) -> StagePlan:
    """The plan of a stage that runs only if features and matches are computed in several jobs.

    Args:
        scattered: Whether it is this stage that has several jobs.
    """
    jobs = math.ceil(len(scan.planned) / int(settled.config.features.photos_per_job))
    why = settled.why["features.photos_per_job"]
    plan = unless_posed(scan, reason, [why] if scattered else [])
    if plan.run and jobs == 1:
        return StagePlan(run=False, reason=why)
    return plan.model_copy(update={"jobs": jobs}) if plan.run and scattered else plan


def if_blocks(settled: Settled, reason: str, *, scattered: bool = False) -> StagePlan:
    """The plan of a stage that runs only if the scene is trained in blocks.

    Args:
        scattered: Whether each block is a job.
    """
    blocks = int(settled.config.partition.blocks)
    if blocks == 1:
        return StagePlan(run=False, reason="the scene is trained as one block")
    return StagePlan(run=True, reason=reason, jobs=blocks if scattered else 1)


def _none(plan: Plan) -> dict[str, Any]:
    return {}


@dataclass(frozen=True)
class StageSpec:
    """The declaration of a stage, in ``stages/<name>.py``.

    Attributes:
        name: The name of the rule, of the module in ``stages/`` and of the folder in
            ``results/<scene>/``.
        work: The function that writes the stage's output into ``Job.out``. It must import heavy
            modules itself, because the Snakefile imports every declaration.
        decide: The pure function that decides whether a scene needs the stage, and why.
        inputs: The stages that can provide each role; the first that the plan runs does.
        counters: The model of the counters that ``work`` records.
        options: The dotted paths of the options or sections that the stage reads; others cannot be
            read (see ``pipeline.config.options``).
        packages: The packages whose version affects the result.
        seeded: Whether the stage draws random numbers. Only the keys of such stages contain the
            seed, so that runs with different seeds share the results of the other stages.
        publishes: The caption in Snakemake's report of each output that is copied to
            ``results/<scene>/``.
        shows_plan: Whether the stage reads the plan (``Job.key["plan"]``, as in plan.json).
        facts: The facts that affect the result besides code, options, packages, seed and inputs.
        scattered: Whether the stage has several jobs, as many as the plan says, each with a folder
            and a log of its own. The key contains the number of the job and of all jobs.
        only_if: Whether the stage reads the input of a role under a configuration. The result of a
            stage that does not read it stays valid when the input's stage runs for another one.
        optional: The roles that have no input if the plan runs none of their stages.
    """

    name: str
    work: Callable[[Job], None]
    decide: Callable[[Scan, Settled], StagePlan]
    inputs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    counters: type[StageCounters] = NoCounters
    options: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()
    seeded: bool = False
    publishes: Mapping[str, str] = field(default_factory=dict)
    shows_plan: bool = False
    facts: Callable[[Plan], dict[str, Any]] = _none
    scattered: bool = False
    only_if: Mapping[str, Callable[[Config], bool]] = field(default_factory=dict)
    optional: tuple[str, ...] = ()

    @property
    def module(self) -> str:
        return f"stages.{self.name}"
