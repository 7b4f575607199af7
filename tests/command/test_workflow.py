"""``splatmake run`` and ``plan``: what is handed to Snakemake."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from snakemake.cli import parse_config

from pipeline.command import workflow
from pipeline.command.main import main
from pipeline.config.load import load_project


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The commands that would have replaced the process."""
    commands: list[list[str]] = []
    monkeypatch.setattr(workflow, "replace_process", commands.append)
    return commands


def config_of(command: list[str]) -> dict[str, Any]:
    """The configuration as Snakemake understands the command."""
    return dict(parse_config(command[command.index("--config") + 1 :]))


def test_the_folder_is_the_scene_and_its_parent_data_root(
    tmp_path: Path, started: list[list[str]]
) -> None:
    """Whatever characters the path has: YAML would take some for its own."""
    photos = tmp_path / "my photos: #1 é" / "garden"
    photos.mkdir(parents=True)
    link = tmp_path / "patio"
    link.symlink_to(photos)
    for folder, name, root in ((photos, "garden", photos.parent), (link, "patio", tmp_path)):
        assert main(["run", str(folder)]) == 0
        command = started.pop()
        assert f"results/{name}/metrics.json" in command
        assert config_of(command) == {"data_root": str(root)}


@pytest.mark.parametrize("mark", [[], ["--"]])
def test_options_are_ours_or_snakemakes(
    tmp_path: Path, started: list[list[str]], mark: list[str]
) -> None:
    theirs = ["--forcerun", "train", "-p", "--jobs", "3"]
    ours = ["--preset", "fast", "--cores", "2", "--config", "seed=3", "train={steps: 5}"]
    assert main(["plan", str(tmp_path), *ours, *mark, *theirs]) == 0
    command = started.pop()
    first = command.index("--dry-run")
    assert command[first + 1 : first + 1 + len(theirs)] == theirs
    assert command[command.index("--cores") + 1] == "2"
    found = config_of(command)
    assert (found["preset"], found["seed"], found["train"]) == ("fast", 3, {"steps": "5"})


def test_profiles_of_the_program_have_names(
    tmp_path: Path,
    started: list[list[str]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(workflow, "_SLURM", "json")  # As if the plugin were installed.
    main(["run", str(tmp_path), "--workflow-profile", "slurm"])
    command = started.pop()
    chosen = Path(command[command.index("--workflow-profile") + 1])
    assert "slurm" in (chosen / "config.yaml").read_text()
    with monkeypatch.context() as without:
        without.setattr(workflow, "_SLURM", "no_such_plugin")
        assert main(["run", str(tmp_path), "--workflow-profile", "slurm"]) == 2
    assert "pip install '.[slurm]'" in capsys.readouterr().err
    (tmp_path / "slurm").mkdir()
    main(["run", str(tmp_path), "--workflow-profile", "slurm"])
    assert str(tmp_path / "slurm") in started.pop()  # the user's own


def test_dotted_names_are_options_of_sections(tmp_path: Path, started: list[list[str]]) -> None:
    given = ["train.steps=5", "train.density.strategy=mcmc", "train={sh_degree: 1}", "seed=3"]
    assert main(["run", str(tmp_path), "--config", *given]) == 0
    found = config_of(started.pop())
    assert found["train"] == {"steps": "5", "density": {"strategy": "mcmc"}, "sh_degree": "1"}
    assert load_project(found)[0].train.steps == 5 and found["seed"] == 3


def test_a_named_scene_is_a_link_beside_the_results(
    tmp_path: Path, started: list[list[str]]
) -> None:
    """A folder whose name Snakemake cannot take, with results in a folder that does not exist."""
    photos, out = tmp_path / "IMG 2024 {1}", tmp_path / "out"
    photos.mkdir()
    for _ in range(2):
        assert main(["run", str(photos), "--name", "garden", "--out", str(out)]) == 0
        command = started.pop()
        assert "results/garden/metrics.json" in command
        assert command[command.index("--directory") + 1] == str(out)
        root = Path(config_of(command)["data_root"])
        assert (root / "garden").samefile(photos) and root.is_relative_to(out)


def test_a_batch_is_all_scenes_of_a_folder(tmp_path: Path, started: list[list[str]]) -> None:
    (tmp_path / "door").mkdir()
    words = ["--configs", "fast,balanced", "--seeds", "0, 1", "--keep-going"]
    assert main(["batch", str(tmp_path), *words]) == 0
    command = started.pop()
    project, _ = load_project(config_of(command))
    assert project.data_root == str(tmp_path) and project.seeds == [0, 1]
    assert list(project.configs) == ["fast", "balanced"]
    assert "all" in command and "--keep-going" in command
