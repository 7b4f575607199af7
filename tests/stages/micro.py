"""Runs stages in this process on scenes of a few tiny photographs.

Must not import torch: pycolmap's stages run in a process of their own
(``pipeline.runtime.isolate``).
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import cv2

from pipeline.config.schema import Config
from pipeline.demo.write import DemoSpec, write_demo
from pipeline.io.colmap import read_model
from pipeline.plan.keys import stage_key
from pipeline.plan.plan import input_folders, upstream
from pipeline.plan.scan import scan
from pipeline.plan.values import Plan
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError
from pipeline.runtime.job import Request, run_stage
from pipeline.runtime.record import content_digest, identity, output_digests
from stages.workflow.registry import STAGES
from tests.plans import make_plan
from tests.videos import write_video

Options = Mapping[str, Any]

SCENES = {
    # As many photographs of this size as structure from motion needs.
    "photos": DemoSpec(views=20, width=200, height=150, poses="colmap", masks=True),
    "raw": DemoSpec(views=3, width=48, height=36, format="dng"),
    "split": DemoSpec(views=6, width=48, height=36, format="png", poses="transforms"),
    "panoramas": DemoSpec(
        views=3, width=64, height=32, distortion="equirectangular", poses="transforms"
    ),
    "alpha": DemoSpec(views=6, width=64, height=48, format="png", alpha=True, poses="colmap"),
}


def write_scenes(folder: Path) -> None:
    for name, spec in SCENES.items():
        write_demo(folder / name, spec)
    _split_in_two(folder / "split")
    photos = folder / "photos"
    shutil.copytree(photos / "images", photos / "others")
    shutil.copytree(photos / "images", folder / "copies")
    first = min((folder / "copies").iterdir())
    shutil.copyfile(first, first.with_stem("zz"))
    # On the surfaces, but not the model's points.
    xyz = read_model(photos / "sparse" / "0").points.xyz
    (photos / "scan.csv").write_text("".join(f"{x},{y},{z}\n" for x, y, z in xyz[::2].tolist()))
    views = [cv2.imread(str(path)) for path in sorted((photos / "images").iterdir())]
    write_video(folder / "video" / "clip.avi", views)


def _split_in_two(scene: Path) -> None:
    """List every second frame for the test, as NeRF-synthetic does."""
    content = json.loads((scene / "transforms.json").read_text())
    (scene / "transforms.json").unlink()
    for name, first in (("train", 0), ("test", 1)):
        part = content | {"frames": content["frames"][first::2]}
        (scene / f"transforms_{name}.json").write_text(json.dumps(part))


def with_option(options: Options, path: str, value: Any) -> dict[str, Any]:
    """``options`` with another value for the option at a dotted path."""
    first, _, rest = path.partition(".")
    return {**options, first: with_option(options.get(first, {}), rest, value) if rest else value}


class Runner:
    """Runs stages below ``folder``; one whose key and inputs have occurred before runs once.

    A run's stages are side by side, as the report reads them: a stage that another run has
    finished is linked from there, as in a folder of results.
    """

    def __init__(self, scenes: Path, folder: Path):
        self._scenes, self._folder = scenes, folder
        self._done: set[tuple[Path, str]] = set()
        self._plan = cache(self._make_plan)

    def outputs(
        self, run: str, scene: str, options: Options, stage: str, **machine: int
    ) -> dict[str, str]:
        """Path -> digest of all outputs of a stage; empty if the plan leaves the stage out, and an
        error in place of the outputs if options are refused.

        Args:
            run: name of the folder of results.
            machine: ``threads`` and ``memory_mb``.
        """
        try:
            plan = self._plan(scene, json.dumps(options))
            if not plan.runs(stage):
                return {}
            folders = self._run(run, plan, stage, machine)
        except UserError as error:
            return {"error": str(error)}
        return {
            name if len(folders) == 1 else f"{folder.name}/{name}": (
                _without_numbers(folder / name) if name.endswith(".html") else digest
            )
            for folder in folders
            for name, digest in output_digests(folder).items()
        }

    def _make_plan(self, scene: str, options: str) -> Plan:
        config = Config.model_validate_json(options)
        folder = self._scenes / scene
        found = scan(folder, scene, config, cache=self._folder / f"{scene}.json")
        return make_plan(found, config, str(folder))

    def _run(self, run: str, plan: Plan, stage: str, machine: Mapping[str, int]) -> list[Path]:
        """The folders of a stage's jobs, which are run."""
        # Results of another machine's run are not linked: they are in a folder of their own.
        root = self._folder / ("other-machine" if machine else "results") / run
        for name in upstream(STAGES[stage], plan).values():
            self._run(run, plan, name, machine)
        sources = input_folders(STAGES[stage], plan)
        folders = {role: root / name for role, name in sources.items()}
        names = plan.stages[stage].folders(stage)
        for number, name in enumerate(names, 1):
            self._run_job(plan, stage, number, root / name, folders, machine)
        return [root / name for name in names]

    def _run_job(
        self,
        plan: Plan,
        stage: str,
        number: int,
        out: Path,
        folders: dict[str, Path],
        machine: Mapping[str, int],
    ) -> None:
        spec = STAGES[stage]
        key = json.loads(stage_key(spec, plan, number))
        digests = {role: content_digest(folder) for role, folder in folders.items()}
        done = out, identity(key | machine, digests)
        if done not in self._done:
            threads, memory_mb = machine.get("threads", 1), machine.get("memory_mb")
            request = Request(stage, key, folders, out, threads, None, {}, memory_mb)
            try:
                code = run_stage(request, spec.work, spec.counters)
            finally:
                tempfile.tempdir = None  # was the stage's scratch folder
            if code == EXIT_USER_ERROR:
                raise UserError(f"{stage} ended with an error")
            assert code == 0, f"{out.name} failed for {out.parent.name}"
            self._done.add(done)


def _without_numbers(page: Path) -> str:
    """The digest of a page without its figures, some of which are times and memory."""
    shown = re.sub(r"(?:\d[\d.,]*(?: (?:s|min|h)\b)? ?)+", "", page.read_text())
    return hashlib.sha256(shown.encode()).hexdigest()
