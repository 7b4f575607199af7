"""Quality by training time: scenes trained with time budgets.

    python -m benchmarks.budgets fox lund_door --data /data --json RECORD.json
    python -m benchmarks.budgets bonsai --data /data/360_v2 --json RECORD.json \\
        --config preset=high 'split={source: published}'

The record is written after every point, and finished points of the same machine, checkout and
options are kept: the same command continues an interrupted one. Budgets count wall time, so nothing
else should run.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from benchmarks.budgets import tables
from benchmarks.budgets.points import Points, Setup, joint_arguments, train
from benchmarks.measured import measured
from benchmarks.results import BudgetResult
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError
from pipeline.runtime.machine import machine_facts, usable_cores

MINUTES = (1.0, 2.0, 4.0, 8.0, 15.0, 30.0)
# Above this load per core of other programs, times are not those of the machine.
HIGH_LOAD = 0.3


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="python -m benchmarks.budgets",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("scenes", nargs="+", metavar="SCENE", help="names of folders in --data")
    made.add_argument("--data", type=Path, required=True, help="folder of the scene folders")
    made.add_argument("--json", type=Path, required=True, metavar="FILE", help="the record")
    made.add_argument("--work", type=Path, default=Path("budgets"), help="folder for results/")
    made.add_argument("--minutes", type=float, nargs="+", default=list(MINUTES), metavar="M")
    made.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="N")
    made.add_argument(
        "--config", nargs="+", default=[], metavar="NAME=VALUE", help="options, as of snakemake"
    )
    made.add_argument("--cores", type=int, default=usable_cores())
    made.add_argument("--note", default="", help="for the record: what else was running")
    return made


def run(setup: Setup, points: Points, asked: argparse.Namespace) -> None:
    """Measure the points that the record lacks.

    Raises:
        UserError: A run fails, or the record holds points of other options.
    """
    for scene in asked.scenes:
        for seed in asked.seeds:
            for minutes in sorted(asked.minutes):
                if points.find(scene, seed, minutes, setup.text) is None:
                    warn_of_load(setup.cores)
                    points.add(train(setup, scene, seed, minutes))


def warn_of_load(cores: int) -> None:
    """Print a warning if other programs use the cores."""
    load = machine_facts()["load_average"]
    if load is not None and load > HIGH_LOAD * cores:
        print(
            f"warning: the load average is {load}: time budgets count wall time, so stop other "
            "programs",
            file=sys.stderr,
        )


def options_of(values: Sequence[str]) -> dict[str, Any]:
    """The configuration of ``NAME=VALUE`` arguments, whose values are YAML.

    Raises:
        UserError: An argument has no "=", or its value is no YAML.
    """
    found: dict[str, Any] = {}
    for text in values:
        name, equals, value = text.partition("=")
        try:
            found[name] = yaml.safe_load(value)
        except yaml.YAMLError:
            equals = ""
        if not name or not equals:
            raise UserError(f"--config {text}: expected NAME=VALUE", fix="as of snakemake --config")
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    asked = parser().parse_args(arguments)
    try:
        asked.work.mkdir(parents=True, exist_ok=True)
        options = options_of(asked.config)
        setup = Setup(asked.data.resolve(), asked.work.resolve(), options, asked.cores)
        points = Points(asked.json, measured("budgets", asked.note, []))
        points.facts = measured("budgets", asked.note, repeated(points.points, asked))
        run(setup, points, asked)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USER_ERROR
    print(tables.table(points.points))
    print(tables.curves(points.points))
    return 0


def repeated(points: Sequence[BudgetResult], asked: argparse.Namespace) -> list[str]:
    """The arguments of the command that repeats all points of the record."""
    wanted = {"scenes": asked.scenes, "minutes": asked.minutes, "seeds": asked.seeds}
    config = ["--config", *asked.config] if asked.config else []
    return [*joint_arguments(points, wanted), "--data", "DATA", *config]


if __name__ == "__main__":
    sys.exit(main())
