"""All stages, in the order of the DAG: every module of ``stages/`` that declares a ``SPEC``."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

from pipeline.plan.stage import StageSpec


def _declared() -> dict[str, StageSpec]:
    folder = Path(__file__).parents[1]
    found = pkgutil.iter_modules([str(folder)])
    names = [module.name for module in found if not module.ispkg]
    modules = (importlib.import_module(f"stages.{n}") for n in names if not n.startswith("_"))
    specs = (getattr(module, "SPEC", None) for module in modules)
    return {spec.name: spec for spec in specs if isinstance(spec, StageSpec)}


def _in_order(specs: dict[str, StageSpec]) -> dict[str, StageSpec]:
    """Topological order: each stage after all its possible inputs; otherwise by name."""
    ordered: dict[str, StageSpec] = {}
    while len(ordered) < len(specs):
        ready = [
            name
            for name, spec in specs.items()
            if name not in ordered and all(ordered.keys() >= set(r) for r in spec.inputs.values())
        ]
        if not ready:
            raise ValueError(f"stages depend on each other: {specs.keys() - ordered.keys()}")
        ordered[min(ready)] = specs[min(ready)]
    return ordered


STAGES: dict[str, StageSpec] = _in_order(_declared())
