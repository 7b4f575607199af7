"""Quality by training time: finished points are kept, other machines and options are refused, and
the tables state what the record holds."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.budgets import __main__ as budgets
from benchmarks.budgets import points, tables
from benchmarks.budgets.points import Points, Setup
from benchmarks.measured import measured
from benchmarks.results import BudgetResult
from pipeline.config.load import scene_config
from pipeline.config.runs import parse_run
from pipeline.runtime.errors import UserError

POINT = BudgetResult(
    *("lego", "{}", 0, 4.0, 9000, 30.0, 0.95, None, 150_000, 4.1, 7.9, 0.5, 2, 1.9),
    *(40, "800x800"),
)
FACTS = measured("budgets", "", [])


def trained(setup: Setup, scene: str, seed: int, minutes: float) -> BudgetResult:
    """A made point, better with more minutes."""
    return replace(
        POINT, scene=scene, seed=seed, minutes=minutes, psnr=25 + minutes + seed, options=setup.text
    )


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int, float]]:
    """The points that are measured, in order."""
    found: list[tuple[str, int, float]] = []

    def train(setup: Setup, scene: str, seed: int, minutes: float) -> BudgetResult:
        found.append((scene, seed, minutes))
        return trained(setup, scene, seed, minutes)

    monkeypatch.setattr(budgets, "train", train)
    return found


def call(folder: Path, *arguments: str) -> int:
    record = folder / "record.json"
    paths = ["--data", str(folder), "--work", str(folder / "work"), "--json", str(record)]
    return budgets.main([*arguments, *paths])


def test_an_interrupted_record_is_continued(
    tmp_path: Path, runs: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(setup: Setup, scene: str, seed: int, minutes: float) -> BudgetResult:
        if minutes == 4:
            raise KeyboardInterrupt
        return trained(setup, scene, seed, minutes)

    with monkeypatch.context() as first:
        first.setattr(budgets, "train", killed)
        with pytest.raises(KeyboardInterrupt):
            call(tmp_path, "fox", "--minutes", "4", "1", "2")
    assert call(tmp_path, "fox", "--minutes", "4", "1", "2") == 0
    assert runs == [("fox", 0, 4.0)]
    assert call(tmp_path, "fox", "lego", "--minutes", "2", "--seeds", "0", "1") == 0
    assert runs[1:] == [("fox", 1, 2.0), ("lego", 0, 2.0), ("lego", 1, 2.0)]
    record = json.loads((tmp_path / "record.json").read_text())
    assert [p["minutes"] for p in record["results"]] == [1, 2, 2, 4, 2, 2]
    repeated = "fox lego --minutes 1 2 4 --seeds 0 1 --data DATA --json FILE"
    assert record["command"] == f"python -m benchmarks.budgets {repeated}"


def test_points_of_other_options_are_not_mixed(
    tmp_path: Path, runs: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(tmp_path, "fox", "--minutes", "1") == 0
    assert call(tmp_path, "fox", "--minutes", "1", "--config", "preset=fast") == 2
    assert 'measured with {}, now {"preset' in capsys.readouterr().err
    assert call(tmp_path, "fox", "--config", "preset") == 2
    assert "expected NAME=VALUE" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["commit", "processor", "instruction_set"])
def test_points_of_another_machine_or_checkout_are_not_mixed(tmp_path: Path, name: str) -> None:
    Points(tmp_path / "a.json", FACTS).add(POINT)
    other = FACTS.model_copy(update={name: "another"})
    with pytest.raises(UserError, match=f"another {name.replace('_', ' ')}"):
        Points(tmp_path / "a.json", other)
    (tmp_path / "b.json").write_text("{}")
    with pytest.raises(UserError, match="expected a record of budgets"):
        Points(tmp_path / "b.json", FACTS)


def test_the_product_is_run_with_the_budget(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a scene by its name, with the options of the command and the training time."""
    called: list[list[str]] = []

    def run(command: list[str], check: bool) -> subprocess.CompletedProcess[str]:
        called.append(command)
        return subprocess.CompletedProcess(command, 1)

    monkeypatch.setattr(points.subprocess, "run", run)
    options = {"preset": "fast", "train": {"sh_degree": 1}}
    setup = Setup(tmp_path / "data", tmp_path, options, 2)
    with pytest.raises(UserError, match=r"fox@minutes_0\.5@seed3 failed"):
        points.train(setup, "fox", 3, 0.5)
    (command,) = called
    raw = json.loads(Path(command[command.index("--configfile") + 1]).read_text())
    target = next(word for word in command if word.startswith("results/"))
    found = parse_run(target.split("/")[1], raw["configs"], ["fox"])
    assert (found.scene, found.seed) == ("fox", 3)
    config = scene_config(raw, "fox", found.config)
    assert (config.preset, config.train.sh_degree, config.train.budget_minutes) == ("fast", 1, 0.5)


# --- tables -------------------------------------------------------------------------------


def test_medians_over_seeds_and_a_curve_by_minutes() -> None:
    setup = Setup(Path(), Path(), {}, 1)
    found = [trained(setup, "fox", seed, m) for m in (1.0, 8.0) for seed in (0, 2)]
    rows = tables.table(found).splitlines()
    assert "| fox | 40, 800x800 | 1 | 2 | 27.00 ±1.00 | 0.950 ±0.000 | - |" in rows[2]
    curves = tables.curves(found).splitlines()
    assert curves[0] == "| scene | 1 min | 8 min | curve of PSNR |"
    assert curves[2:] == ["| fox | 27.00 | 34.00 | ▁█ |"]


def test_a_table_without_records_is_dashes() -> None:
    for made in (tables.table([]), tables.curves([])):
        lines = made.splitlines()
        assert len(lines) == 3 and set(lines[2]) == set("| -")
