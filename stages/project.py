"""The face the Snakefile sees: scenes, their plans, and each rule's inputs and key."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

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
        try:
            self._project, named = load_project(self._raw)
        except UserError as error:
            _exit(error)
        for name in named:
            if not (Path(self._project.data_root) / name).is_dir():
                print(f"warning: scenes.{name}: no such folder in data_root", file=sys.stderr)
        self._make_plan = cache(self._scan_and_plan)
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

    def every_scene(self, wildcards: Any) -> list[str]:
        """Input function: the metrics of all scenes below ``data_root``. A folder that is no
        scene is left out with its message."""
        root = Path(self._project.data_root)
        names = sorted(p.name for p in root.glob("*") if p.is_dir() and p.name[0] not in "._")
        targets = []
        for name in names:
            try:
                self._make_plan(name)
            except UserError as error:
                print(f"left out: {error}", file=sys.stderr)
            else:
                targets.append(str(RESULTS / name / "metrics.json"))
        if not targets:
            fix = "set data_root to the folder whose subfolders are scenes"
            _exit(UserError("no scene here", file=root, fix=fix))
        return targets

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

    def _plan(self, scene: str) -> tuple[Plan, str, str]:
        """The scene's plan, folder and fingerprint; a UserError ends Snakemake."""
        try:
            return self._make_plan(scene)
        except UserError as error:
            _exit(error)

    def _scan_and_plan(self, scene: str) -> tuple[Plan, str, str]:
        config = scene_config(self._raw, scene)
        folder = Path(self._project.data_root) / scene
        found = scan(folder, scene, config, cache=RESULTS / scene / ".scratch" / "scan.json")
        plan = make_plan(found, config)
        print(describe(plan), file=sys.stderr)
        return plan, str(folder), found.fingerprint


def _exit(error: UserError) -> NoReturn:
    """A user's error while the DAG is built ends Snakemake with its message alone."""
    print(f"error: {error}", file=sys.stderr, flush=True)
    raise SystemExit(2) from None
