"""Bad scenes in a batch: each is left out with its reason, and the others are planned."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.command.main import main
from stages.workflow.project import SnakemakeProject
from tests.pictures import photos
from tests.stages.flow import dry_run

NAMES = ("<x>", "{x}", "ab" * 20, "n" * 250, "a\nb", "\udcff")


@pytest.fixture
def data(tmp_path, monkeypatch) -> Path:
    """The folder of scenes, with one good scene; results are beside it."""
    monkeypatch.chdir(tmp_path)
    photos(tmp_path / "data" / "good", 3)
    return tmp_path / "data"


def runs(**config: object) -> tuple[list[str], dict[str, str]]:
    """The scenes that can be planned, and why the others cannot."""
    project = SnakemakeProject(config, dry_run())
    found, left_out = project._batch
    planned = [run.scene for run in found if run not in left_out]
    assert {Path(file).parts[1] for file in project.every_run(None)} == set(planned)
    return planned, {run.scene: reason for run, reason in left_out.items()}


def test_scenes_with_impossible_names(data, capfd):
    for name in NAMES:
        photos(data / name, 2)
    planned, left_out = runs()
    assert planned == ["good"]
    assert left_out.keys() == set(NAMES)
    said = capfd.readouterr().err
    assert said.count("the name of a scene or of a run cannot be used") == len(NAMES)
    assert said.replace("\n", "").isprintable()


@pytest.mark.parametrize("name", NAMES)
def test_a_single_scene_with_an_impossible_name(data, name, capfd):
    photos(data / name, 2)
    assert main(["plan", str(data / name)]) == 2
    assert "--name garden" in capfd.readouterr().err


def test_scenes_with_pipes_devices_and_broken_poses(data):
    (data / "pipe").mkdir()
    os.mkfifo(data / "pipe" / "x.jpg")
    (data / "device").mkdir()
    (data / "device" / "x.jpg").symlink_to("/dev/zero")
    photos(data / "poses", 2)
    (data / "poses" / "transforms.json").write_text("{")
    photos(data / "control", 2)
    os.mkfifo(data / "control" / "gcp_list.txt")
    (data / "text").write_text("no folder")
    (data / "loop").symlink_to("loop")
    planned, left_out = runs()
    assert planned == ["control", "good"]
    assert "none of the 1 photographs and videos can be read" in left_out["pipe"]
    assert "not a regular file" in left_out["device"]
    assert "transforms.json: line 1" in left_out["poses"]


def test_a_folder_without_permission(data, monkeypatch):
    """As lost+found at the root of a file system."""
    (data / "lost+found").mkdir()
    real = Path.is_dir

    def is_dir(path: Path) -> bool:
        if path.parent.name == "lost+found":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return real(path)

    monkeypatch.setattr(Path, "is_dir", is_dir)
    planned, left_out = runs()
    assert planned == ["good"]
    assert "cannot be read: Permission denied" in left_out["lost+found"]
    assert "what to do" in left_out["lost+found"]


def test_results_that_cannot_be_written(data, monkeypatch):
    photos(data / "other", 2)
    results = data.parent / "results" / "other"
    results.mkdir(parents=True)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "other")
    planned, left_out = runs()
    assert planned == ["good"]
    assert "results/other: this folder of results cannot be written" in left_out["other"]
    # Finished results may be read-only: there is nothing to write.
    (results / "metrics.json").write_text("{}")
    assert runs()[0] == ["good", "other"]


def test_finished_results_that_are_to_be_made_again_but_cannot_be_written(data, monkeypatch, capfd):
    results = data.parent / "results" / "good"
    results.mkdir(parents=True)
    (results / "metrics.json").write_text("{}")
    rule = SimpleNamespace(name="benchmark")
    job = SimpleNamespace(rule=rule, wildcards=SimpleNamespace(scene="good"), output=["x"])
    batch = SimpleNamespace(rule=rule, wildcards=SimpleNamespace(), output=[])
    dag = SimpleNamespace(needrun_jobs=lambda: [batch, job])
    project = SnakemakeProject({}, dry_run(dag=dag, scheduler=SimpleNamespace()))
    project.before_jobs()
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "good")
    with pytest.raises(SystemExit):
        project.before_jobs()
    said = capfd.readouterr().err
    assert "results/good: this folder of results cannot be written" in said


def test_a_data_root_without_permission(data, monkeypatch, capfd):
    def glob(path: Path, pattern: str) -> list[Path]:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "glob", glob)
    with pytest.raises(SystemExit):
        runs()
    assert "data: cannot be read: Permission denied" in capfd.readouterr().err
