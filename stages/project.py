"""The face the Snakefile sees: scenes, their plans, and each rule's inputs and key."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from pipeline.config.load import load_project, scene_config
from pipeline.runtime.errors import UserError
from pipeline.runtime.job import canonical
from pipeline.scene.plan import Plan, describe, make_plan
from pipeline.scene.scan import scan
from stages.wiring import public_plan, stage_key, upstream

RESULTS = Path("results")


class SnakemakeProject:
    """Binds scenes, their options and their plans to Snakemake's input functions.

    Args:
        raw: Snakemake's ``config``.
        basedir: the folder of the Snakefile.

    Raises:
        UserError: the configuration is not valid, before any job starts.
    """

    def __init__(self, raw: Mapping[str, Any], basedir: str):
        self._raw = dict(raw)
        self._started = time.time()
        self._project = _or_exit(lambda: load_project(self._raw))[0]
        self._plan = cache(self._make_plan)
        # Set here and not in the rules' text, which counts as code: moving the project or its
        # virtual environment must not rerun anything.
        os.environ["PYTHONPATH"] = os.pathsep.join(
            filter(None, [basedir, os.environ.get("PYTHONPATH", "")])
        )
        os.environ["PATH"] = os.pathsep.join(
            [str(Path(sys.executable).parent), os.environ.get("PATH", "")]
        )
        # Spinning OpenMP threads slow whatever runs beside them.
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")

    def scenes(self) -> list[str]:
        """Names of the folders below ``data_root``, sorted."""
        root = Path(self._project.data_root)
        if not root.is_dir():
            return []
        return sorted(p.name for p in root.iterdir() if p.is_dir() and p.name[0] not in "._")

    def inputs(self, stage: str) -> Callable[[Any], dict[str, str]]:
        """Input function: role -> the ``stage.json`` that fills it."""
        return lambda wildcards: {
            role: str(RESULTS / wildcards.scene / source / "stage.json")
            for role, source in upstream(stage, self._plan(wildcards.scene)[0]).items()
        }

    def folders(self, stage: str) -> Callable[[Any], list[str]]:
        """Params function: "role=folder" for the stage's command line."""
        return lambda wildcards: [
            f"{role}={RESULTS / wildcards.scene / source}"
            for role, source in upstream(stage, self._plan(wildcards.scene)[0]).items()
        ]

    def published(self, *names: str) -> Callable[[Any], list[str]]:
        """Params function: outputs of a stage that stand in the scene's own folder as well."""
        return lambda wildcards: [f"{name}={RESULTS / wildcards.scene / name}" for name in names]

    def key(self, stage: str) -> Callable[[Any], str]:
        """Params function: the stage's key."""
        return lambda wildcards: stage_key(stage, *self._plan(wildcards.scene))

    def plan(self, wildcards: Any) -> str:
        """Params function: the plan as canonical JSON."""
        return canonical(public_plan(self._plan(wildcards.scene)[0]))

    def explain_failures(self) -> None:
        """Say again, last of all, what stopped the stages that failed in this run."""
        for log in sorted(RESULTS.glob("*/logs/*.log")):
            _, found, message = f"\n{log.read_text()}".rpartition("\nerror in ")
            if log.stat().st_mtime >= self._started and found:
                print(f"\nerror in {message}", file=sys.stderr, end="")

    def _make_plan(self, scene: str) -> tuple[Plan, str, str]:
        def make() -> tuple[Plan, str, str]:
            config = scene_config(self._raw, scene)
            folder = Path(self._project.data_root) / scene
            found = scan(folder, scene, config, cache=RESULTS / scene / ".scratch" / "scan.json")
            return make_plan(found, config), str(folder), found.fingerprint

        plan, folder, fingerprint = _or_exit(make)
        print(describe(plan), file=sys.stderr)
        return plan, folder, fingerprint


def _or_exit(work: Callable[[], Any]) -> Any:
    """A user's error while the DAG is built ends Snakemake with its message alone."""
    try:
        return work()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        sys.stderr.flush()
        raise SystemExit(2) from None
