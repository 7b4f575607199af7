"""Points of the curve of quality by training time: runs of the product under a time budget, and the
record that holds the finished ones."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from benchmarks.measured import Measured, Record
from benchmarks.record import POSES
from benchmarks.results import BudgetResult
from pipeline.config.runs import Run
from pipeline.metrics.evaluation import Evaluation
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError
from pipeline.runtime.record import read_stage

ROOT = Path(__file__).resolve().parents[2]
# A record holds points of one machine and checkout.
SAME = ("commit", "processor", "cores", "instruction_set", "compiler")


@dataclass(frozen=True)
class Setup:
    """How the product is run.

    Attributes:
        data: The folder of the scene folders.
        work: The folder for ``results/``.
        options: The configuration besides the time budget.
        cores: The number of cores.
    """

    data: Path
    work: Path
    options: dict[str, Any]
    cores: int

    @property
    def text(self) -> str:
        """The options in one line, for the record."""
        return json.dumps(self.options, sort_keys=True)

    def run(self, scene: str, seed: int, minutes: float) -> Run:
        return Run(scene, f"minutes_{minutes:g}", seed)

    def results(self, scene: str, seed: int, minutes: float) -> Path:
        return self.work / "results" / self.run(scene, seed, minutes).name


def train(setup: Setup, scene: str, seed: int, minutes: float) -> BudgetResult:
    """Train a scene for a time and measure it.

    Raises:
        UserError: The run failed.
    """
    run = setup.run(scene, seed, minutes)
    training = {**setup.options.get("train", {}), "budget_minutes": minutes}
    options = {**setup.options, "train": training}
    config = {"data_root": str(setup.data), "configs": {run.config: options}}
    file = setup.work / f"{run.config}.json"
    write_json(file, config)
    targets = [f"results/{run.name}/{name}" for name in ("plan.json", "evaluate/stage.json")]
    command = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), *targets]
    command += ["--directory", str(setup.work), "--cores", str(setup.cores)]
    command += ["--configfile", str(file)]
    if subprocess.run(command, check=False).returncode:
        raise UserError(
            f"the run {run.name} failed; its messages are above",
            fix="remove the cause, and run this command again: finished points are kept",
        )
    return measured_point(setup, scene, seed, minutes)


def measured_point(setup: Setup, scene: str, seed: int, minutes: float) -> BudgetResult:
    """The result of a finished run.

    Raises:
        UserError: It was trained in blocks, whose times are not those of one training.
    """
    results = setup.results(scene, seed, minutes)
    if not (results / "train" / "run.json").is_file():
        raise UserError(
            "expected a scene that is trained as one block", file=results, fix="use a smaller scene"
        )
    evaluation = Evaluation.read(results / "evaluate")
    runs = {path.parent.name: json.loads(path.read_text()) for path in results.glob("*/run.json")}
    trained = runs["train"]
    before = sum(
        runs[stage]["cpu_s"] for stage in ("inspect", *POSES, "dense", "init") & runs.keys()
    )
    protocol = evaluation.protocol
    return BudgetResult(
        scene=scene,
        options=setup.text,
        seed=seed,
        minutes=minutes,
        steps=read_stage(results / "train").counters["steps"],
        psnr=evaluation.psnr,
        ssim=evaluation.ssim,
        flip=evaluation.flip,
        lpips=evaluation.lpips,
        gaussians=evaluation.model.num_gaussians,
        wall_minutes=trained["wall_s"] / 60,
        cpu_minutes=trained["cpu_s"] / 60,
        other_cpu_minutes=before / 60,
        threads=trained["threads"],
        load_average=trained["load_average"],
        test_views=protocol.num_views,
        pixels=", ".join(protocol.resolution),
    )


class Points:
    """The finished points, in a record that is written after each one.

    Attributes:
        path: The file of the record.
        facts: The facts of this machine and checkout; the command is that of all points.
    """

    def __init__(self, path: Path, facts: Measured) -> None:
        """Read the points of an earlier call.

        Raises:
            UserError: The record cannot be read, or is of another machine or checkout.
        """
        self.path, self.facts = path, facts
        self.points: list[BudgetResult] = []
        if not path.exists():
            return
        try:
            found = Record[BudgetResult].model_validate_json(path.read_bytes())
        except (OSError, ValidationError) as error:
            raise UserError(
                f"expected a record of budgets of this version: {error}",
                file=path,
                fix="name another file for the record",
            ) from None
        for name in SAME:
            if (old := getattr(found, name)) != (new := getattr(facts, name)):
                raise UserError(
                    f"its points are of another {name.replace('_', ' ')}: {old}, now {new}",
                    file=path,
                    fix="name another file, or continue where the record was begun",
                )
        self.points = found.results

    def find(self, scene: str, seed: int, minutes: float, options: str) -> BudgetResult | None:
        """The finished point, or None.

        Raises:
            UserError: It was measured with other options.
        """
        for point in self.points:
            if (point.scene, point.seed, point.minutes) != (scene, seed, minutes):
                continue
            if point.options != options:
                raise UserError(
                    f"{scene}, {minutes:g} minutes: measured with {point.options}, now {options}",
                    file=self.path,
                    fix="name another file for these options",
                )
            return point
        return None

    def add(self, point: BudgetResult) -> None:
        """Add a point and write the record."""
        self.points.append(point)
        self.points.sort(key=lambda p: (p.scene, p.minutes, p.seed))
        record = Record[BudgetResult](**self.facts.model_dump(), results=self.points)
        write_json(self.path, record.model_dump(mode="json"))


def joint_arguments(points: Sequence[BudgetResult], asked: dict[str, list[Any]]) -> list[str]:
    """The arguments of the command that repeats the points of a record and those asked for."""
    scenes = dict.fromkeys([*(p.scene for p in points), *asked["scenes"]])
    minutes = sorted({*(p.minutes for p in points), *asked["minutes"]})
    seeds = sorted({*(p.seed for p in points), *asked["seeds"]})
    return [
        *scenes,
        *("--minutes", *(f"{value:g}" for value in minutes)),
        *("--seeds", *map(str, seeds)),
    ]
