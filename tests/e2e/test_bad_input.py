"""Bad input through Snakemake: one clear message, a non-zero exit, nothing half-written."""

from __future__ import annotations

import json
import shutil
import subprocess

import numpy as np
import pytest
from PIL import Image

from tests.e2e.harness import TINY, copy_run, make_project, rules_run, snakemake
from tests.tools import unsupported

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    return make_project(tmp_path_factory.mktemp("bad") / "project")


@pytest.fixture
def photographs(finished, project, request):
    """The tiny scene's photographs in a scene folder of the test's own."""
    folder = project / "data" / request.node.name.replace("[", "_").rstrip("]")
    shutil.copytree(finished / "data" / "tiny" / "images", folder / "images")
    return folder


def fails(project, scene, *named, config=TINY):
    done = snakemake(project, f"results/{scene}/metrics.json", config=config, check=False)
    assert done.returncode != 0
    assert "Traceback" not in done.stdout, done.stdout
    for text in named:
        assert text in done.stdout, done.stdout
    folder = project / "results" / scene
    assert not (folder / "metrics.json").exists()
    assert not list(folder.glob(".scratch/*/*/out")), "half output was left"
    return done


def noise(folder, count, size=(160, 120), seed=0):
    """Photographs that show nothing in common."""
    generator = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        small = generator.integers(0, 255, (size[1] // 4, size[0] // 4, 3), np.uint8)
        Image.fromarray(small).resize(size, Image.Resampling.BICUBIC).save(
            folder / f"{seed}_{index:02d}.jpg"
        )


def test_a_scene_that_is_not_there(project):
    (project / "data" / "lion").mkdir(parents=True, exist_ok=True)
    fails(project, "loin", "loin", "what to do", "lion")


def test_an_empty_folder(project):
    (project / "data" / "empty" / "images").mkdir(parents=True, exist_ok=True)
    fails(project, "empty", "data/empty", "what to do")


def test_one_photograph(project):
    noise(project / "data/one/images", 1)
    fails(project, "one", "data/one", "what to do")


def test_only_texts_called_jpg(project):
    folder = project / "data/texts/images"
    folder.mkdir(parents=True)
    for index in range(3):
        (folder / f"{index}.jpg").write_text("not a picture")
    fails(project, "texts", "data/texts", "what to do")


def test_photographs_without_anything_in_common(project):
    noise(project / "data/noise/images", 4)
    fails(project, "noise", "what to do")


@pytest.mark.parametrize(
    "text", ['{"frames": [', '{"frames": []}', '{"frames": [{"file_path": "a.png"}]}', "[]"]
)
def test_malformed_transforms(project, text):
    folder = project / "data/transforms"
    shutil.rmtree(folder, ignore_errors=True)
    noise(folder / "images", 3)
    (folder / "transforms.json").write_text(text)
    fails(project, "transforms", "transforms.json", "what to do")


def test_poses_that_are_not_numbers(project):
    folder = project / "data/nan"
    noise(folder / "images", 3)
    frames = [
        {"file_path": f"images/0_{i:02d}.jpg", "transform_matrix": np.eye(4).tolist()}
        for i in range(3)
    ]
    frames[1]["transform_matrix"][0][3] = float("nan")
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 100.0, "frames": frames}))
    fails(project, "nan", "transforms.json", "0_01.jpg", "what to do")


def test_unreadable_raw_files(project):
    folder = project / "data/raw/images"
    folder.mkdir(parents=True)
    for index in range(3):
        (folder / f"{index}.dng").write_bytes(b"II*\0" + bytes(200))
    fails(project, "raw", "what to do")


def test_a_typo_is_named_before_any_job(finished, tmp_path):
    project = copy_run(finished, tmp_path / "project")
    done = snakemake(
        project, "results/tiny/metrics.json", config={"train": {"stepz": 1}}, check=False
    )
    assert done.returncode != 0
    assert "train.stepz: no such option" in done.stdout
    assert rules_run(done) == set()
    assert "Traceback" not in done.stdout


def test_one_bad_photograph_is_left_out_with_a_warning(project, photographs):
    images = sorted((photographs / "images").iterdir())
    data = images[3].read_bytes()
    images[3].write_bytes(data[: len(data) // 2])
    (photographs / "images" / "notes.jpg").write_text("not a picture")
    scene = photographs.name
    few = TINY | {"train": TINY["train"] | {"steps": 40}, "data_root": str(project / "data")}
    snakemake(project, f"results/{scene}/metrics.json", config=few)
    found = json.loads((project / f"results/{scene}/metrics.json").read_text())
    assert str(project) not in json.dumps(found), "metrics.json holds a path of this machine"
    inspected = json.loads((project / f"results/{scene}/inspect/stage.json").read_text())
    assert str(project) not in "".join(inspected["warnings"])
    warned = "\n".join(found["warnings"])
    assert images[3].name in warned
    assert "notes.jpg" in warned
    assert found["registered_images"] == len(images) - 1


def test_two_disconnected_sets_are_reported(project, photographs):
    noise(photographs / "images", 3, seed=7)
    scene = photographs.name
    snakemake(project, f"results/{scene}/sfm/stage.json", config=TINY)
    record = json.loads((project / f"results/{scene}/sfm/stage.json").read_text())
    matched = json.loads((project / f"results/{scene}/matches/stage.json").read_text())
    said = "\n".join(record["warnings"] + matched["warnings"])
    assert "7_00.jpg" in said
    assert record["counters"]["registered"] < record["counters"]["total"]


def test_all_scenes_leave_out_a_folder_that_is_none(finished, tmp_path):
    project = copy_run(finished, tmp_path / "project")
    (project / "data" / "notes").mkdir()
    done = snakemake(project, "-n", config=TINY)
    assert "left out: data/notes" in done.stdout
    assert rules_run(done) == {"benchmark", "all"}
    lost = snakemake(project, config=TINY | {"data_root": "dta"}, check=False)
    assert lost.returncode != 0
    assert "dta: expected scene folders, found none" in lost.stdout


def test_results_that_cannot_be_written(finished, tmp_path):
    """A small file system stands for a full disk; without the right to mount one, skip."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(disk)], check=False
    )
    if mounted.returncode != 0:
        unsupported("needs the right to mount a small file system")
    try:
        small = make_project(tmp_path / "small")
        shutil.copytree(finished / "data", small / "data")
        (small / "results").symlink_to(disk)
        fails(small, "tiny", "disk is full", "what to do")
    finally:
        subprocess.run(["umount", str(disk)], check=True)
