"""The key of a stage, which changes whenever the stage's result may change."""

from __future__ import annotations

from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from pipeline.config.options import select
from pipeline.plan.plan import plan_record
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import Plan
from pipeline.runtime.record import canonical
from pipeline.runtime.source import gpu_source_hash, stage_source_hash

# The versions are computed once for all runs of a batch.
_version = cache(version)
_source_hash = cache(stage_source_hash)


def installed_version(package: str) -> str | None:
    """The version of a package; None if it is not installed, which the job reports."""
    try:
        return _version(package)
    except PackageNotFoundError:
        return None


def stage_key(spec: StageSpec, plan: Plan, job: int = 1) -> str:
    """The stage's key as a canonical JSON string.

    The key consists of the declared options as settled by the plan, a hash of the code that the
    stage can reach, the versions of the declared packages, the seed if the stage is seeded, and the
    declared facts. Time, memory, threads and hosts are not part of it. It is a single string
    because Snakemake compares parameters as a set of ``repr(value)``, which would miss changes.

    Args:
        job: The number of the job, from 1. The key contains it only for stages with several jobs.
    """
    key: dict[str, Any] = {
        "stage": spec.name,
        "seed": plan.config.seed if spec.seeded else None,
        "source": _source_hash(spec.module),
        "packages": {name: _version(name) for name in spec.packages},
        "config": select(plan.config, spec.options),
    }
    if uses_gpu(spec, plan):
        key |= {"gpu_source": gpu_source_hash()}
        key["packages"] = {**key["packages"], "wgpu": installed_version("wgpu")}
    if spec.scattered:
        key |= {"job": job, "jobs": plan.stages[spec.name].jobs}
    if spec.shows_plan:
        key["plan"] = plan_record(plan).model_dump(mode="json")
    return canonical(key | spec.facts(plan))


def uses_gpu(spec: StageSpec, plan: Plan) -> bool:
    """Whether the stage trains or renders on a GPU."""
    renders = not {"train", "train.device"}.isdisjoint(spec.options)
    return renders and plan.config.train.device.startswith("gpu")
