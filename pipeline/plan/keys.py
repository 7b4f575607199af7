"""The key of a stage: it changes exactly where the stage's result may."""

from __future__ import annotations

from functools import cache
from importlib.metadata import version
from typing import Any

from pipeline.config.options import select
from pipeline.plan.plan import Plan, public_plan
from pipeline.plan.stage import StageSpec
from pipeline.runtime.record import canonical
from pipeline.runtime.source import stage_source_hash

# Asked again for every run of a batch.
_version = cache(version)
_source_hash = cache(stage_source_hash)


def stage_key(spec: StageSpec, plan: Plan) -> str:
    """The stage's key as one canonical JSON string.

    Snakemake compares parameters as a set of ``repr(value)``, so only a single canonical string
    notices every change. The key holds the declared options as the plan settled them, a hash of the
    code that the stage can reach, the versions of the declared packages, the seed where the stage
    draws, and the declared facts. Time, memory, threads and hosts are in no key.
    """
    key: dict[str, Any] = {
        "stage": spec.name,
        "seed": plan.config.seed if spec.seeded else None,
        "source": _source_hash(spec.module),
        "packages": {name: _version(name) for name in spec.packages},
        "config": select(plan.config, spec.options),
    }
    if spec.shows_plan:
        key["plan"] = public_plan(plan)
    return canonical(key | spec.facts(plan))
