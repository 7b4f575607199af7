"""Bad input through Snakemake: one clear message, a non-zero exit, nothing half-written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages.workflow.project import SnakemakeProject, check_config
from tests.e2e.harness import TINY, copy_run, make_project, metrics, rules_run, snakemake
from tests.stages.flow import dry_run

pytestmark = pytest.mark.slow


def noise(folder: Path, count: int, size: tuple[int, int] = (160, 120), seed: int = 0) -> None:
    """Photographs that show nothing in common."""
    generator = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        small = generator.integers(0, 255, (size[1] // 4, size[0] // 4, 3), np.uint8)
        Image.fromarray(small).resize(size, Image.Resampling.BICUBIC).save(
            folder / f"{seed}_{index:02d}.jpg"
        )


def test_a_scene_that_is_not_there(tmp_path):
    project = make_project(tmp_path / "project")
    (project / "data" / "lion").mkdir(parents=True)
    done = snakemake(project, "results/loin/metrics.json", config=TINY, check=False)
    assert done.returncode != 0
    assert "Traceback" not in done.stdout
    for text in ("loin", "what to do", "lion"):
        assert text in done.stdout
    assert not (project / "results").exists()


def transforms(text: str):
    def write(scene: Path) -> None:
        noise(scene / "images", 3)
        (scene / "transforms.json").write_text(text)

    return write


def poses_that_are_not_numbers(scene: Path) -> None:
    frames = [
        {"file_path": f"images/0_{i:02d}.jpg", "transform_matrix": np.eye(4).tolist()}
        for i in range(3)
    ]
    frames[1]["transform_matrix"][0][3] = float("nan")
    transforms(json.dumps({"fl_x": 100.0, "frames": frames}))(scene)


def files(name: str, content: bytes):
    def write(scene: Path) -> None:
        (scene / "images").mkdir(parents=True)
        for index in range(3):
            (scene / "images" / f"{index}{name}").write_bytes(content)

    return write


BAD = {
    "empty": (lambda scene: (scene / "images").mkdir(parents=True), ()),
    "one": (lambda scene: noise(scene / "images", 1), ()),
    "texts": (files(".jpg", b"not a picture"), ()),
    "raw": (files(".dng", b"II*\0" + bytes(200)), ()),
    "cut": (transforms('{"frames": ['), ("transforms.json",)),
    "no-frames": (transforms('{"frames": []}'), ("transforms.json",)),
    "no-matrix": (transforms('{"frames": [{"file_path": "a.png"}]}'), ("transforms.json",)),
    "list": (transforms("[]"), ("transforms.json",)),
    "nan": (poses_that_are_not_numbers, ("transforms.json", "0_01.jpg")),
}


def test_bad_scenes_are_left_out_of_a_batch_with_their_reasons(finished, tmp_path):
    project = copy_run(finished, tmp_path / "project")
    for name, (write, _) in BAD.items():
        write(project / "data" / name)
    done = snakemake(project, "-n", config=TINY)
    assert "Traceback" not in done.stdout
    assert rules_run(done) == {"benchmark", "all"}
    for name, (_, named) in BAD.items():
        _, _, reason = done.stdout.partition(f"left out: data/{name}")
        reason = reason.partition("left out: data/")[0]
        for text in ("what to do", *named):
            assert text in reason, name


@pytest.mark.parametrize(
    ("config", "text"),
    [
        ({"train": {"stepz": 1}}, "train.stepz: no such option"),
        ({"data_root": "dta"}, "dta: expected scene folders, found none"),
    ],
)
def test_a_bad_configuration_is_named_before_any_job(tmp_path, monkeypatch, capfd, config, text):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        SnakemakeProject(config, dry_run()).every_run(None)
    assert ended.value.code == 2
    assert text in capfd.readouterr().err


def test_a_configuration_in_utf_16_is_named(tmp_path, capfd):
    (tmp_path / "config.yaml").write_bytes("preset: fast\n".encode("utf-16"))
    with pytest.raises(SystemExit):
        check_config(str(tmp_path / "config.yaml"))
    assert "config.yaml: expected text in UTF-8" in capfd.readouterr().err


def test_photographs_that_cannot_be_used_are_left_out_with_a_warning(finished, tmp_path):
    """One is damaged, one is a text, and three show something else."""
    project = make_project(tmp_path / "project")
    folder = project / "data" / "bad" / "images"
    shutil.copytree(finished / "data" / "tiny" / "images", folder)
    images = sorted(folder.iterdir())
    data = images[3].read_bytes()
    images[3].write_bytes(data[: len(data) // 2])
    (folder / "notes.jpg").write_text("not a picture")
    noise(folder, 3, seed=7)
    few = TINY | {"train": TINY["train"] | {"steps": 40}, "data_root": str(project / "data")}
    snakemake(project, "results/bad/metrics.json", config=few)
    found = metrics(project, "bad")
    assert str(project) not in json.dumps(found), "metrics.json holds a path of this machine"
    inspected = json.loads((project / "results/bad/inspect/stage.json").read_text())
    assert str(project) not in "".join(inspected["warnings"])
    warned = "\n".join(found["warnings"])
    for name in (images[3].name, "notes.jpg", "7_00.jpg"):
        assert name in warned
    assert found["registered_images"] == len(images) - 1
