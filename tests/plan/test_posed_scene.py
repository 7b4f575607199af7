"""Results of an unfinished or damaged run are one error that names the file and the command."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import splatmake
from pipeline.config.schema import Config
from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import write_model
from pipeline.io.npz import write_npz
from pipeline.plan.values import StagePlan
from pipeline.runtime.atomic import write_json
from pipeline.runtime.record import StageRecord
from pipeline.scene.exposure import NO_GAINS, ExposureGains, ViewLight
from pipeline.scene.georeference import CartesianOrigin, Georeference
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import PosedImage, Reconstruction
from splatmake import Scene, UserError
from tests.plans import record_of
from tests.splats.samples import sample


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A finished scene, as far as ``splatmake.load`` reads it."""
    folder = tmp_path / "results" / "barn"
    photos = [
        Photo(name=f"{i}.png", path=f"data/{i}.png", width=8, height=6, digest="") for i in range(3)
    ]
    Manifest(scene="barn", photos=tuple(photos)).write(folder / "inspect" / "images.json")
    camera = Camera("PINHOLE", 8, 6, np.array([8.0, 8, 4, 3]))
    images = {
        i + 1: PosedImage(f"{i}.png", 1, np.eye(3), np.array([float(i), 0, 4])) for i in range(3)
    }
    write_model(folder / "inspect" / "sparse" / "0", Reconstruction({1: camera}, images))
    plan = record_of({"inspect": StagePlan(run=True, reason="")})
    write_json(folder / "plan.json", plan.model_dump(mode="json"))
    config = Config().model_dump(mode="json")
    record = StageRecord(
        stage="train",
        scene="barn",
        key={"config": {name: config[name] for name in ("views", "split", "train")}},
        inputs={},
        outputs={},
        counters={},
        decisions=(),
        warnings=(),
    )
    write_json(folder / "train" / "stage.json", record.model_dump(mode="json"))
    NO_GAINS.write(folder / "train")
    write_npz(folder / "train" / "gaussians.npz", sample(5))
    return folder


def error(folder: Path) -> str:
    """The message of loading a scene."""
    with pytest.raises(UserError) as caught:
        splatmake.load(folder)
    return str(caught.value)


def test_a_finished_scene_is_loaded(results: Path) -> None:
    scene = splatmake.load(results)
    assert repr(scene) == "Scene('barn': 5 Gaussians, 3 views, 1 test)"
    np.testing.assert_allclose(scene.up, (0, -1, 0), atol=1e-12)
    assert [view.name for view in scene.test_views] == ["0.png"] and len(scene.views) == 3
    view = scene.view("1")
    assert (scene.render(splatmake.Camera.of(view)).rgb == scene.render(view).rgb).all()


@pytest.mark.parametrize(
    ("missing", "named"),
    [
        ("plan.json", "plan.json"),
        ("train/stage.json", "train/stage.json"),
        ("inspect/images.json", "inspect/images.json"),
        ("inspect/sparse/0", "inspect/sparse/0"),
    ],
)
def test_an_unfinished_scene_is_one_error(results: Path, missing: str, named: str) -> None:
    (results / ".scratch").mkdir()
    file = results / missing
    file.rename(file.with_name("aside"))
    text = error(results)
    assert "expected a finished scene, found no " in text and named in text.splitlines()[0]
    assert f"snakemake --cores all {results}/metrics.json" in text


def test_a_run_that_has_just_begun_is_unfinished(tmp_path: Path) -> None:
    (tmp_path / "barn" / ".scratch").mkdir(parents=True)
    assert "expected a finished scene, found no plan.json" in error(tmp_path / "barn")


@pytest.mark.parametrize("name", ["stage.json", "exposure.json", "gaussians.npz"])
def test_a_truncated_file_is_one_error(results: Path, name: str) -> None:
    file = results / "train" / name
    file.write_bytes(file.read_bytes()[:-3])
    assert str(file) in error(results)


def test_settings_of_another_version_are_one_error(results: Path) -> None:
    file = results / "train" / "stage.json"
    content = json.loads(file.read_text())
    del content["key"]["config"]["split"]
    write_json(file, content)
    text = error(results)
    assert "settings of a training by this version" in text and "--forcerun train" in text


def test_gains_of_other_views_are_one_error(results: Path) -> None:
    ExposureGains({"0.png": ViewLight(gain=(1.0, 1.0, 1.0))}).write(results / "train")
    assert "found none for 1.png" in error(results)


def test_a_missing_model_is_one_error(results: Path) -> None:
    (results / "train" / "gaussians.npz").unlink()
    assert "found no train/gaussians.npz" in error(results)


def test_exports_are_in_the_unit_of_given_poses(results: Path, tmp_path: Path) -> None:
    """A scene that was scaled for training renders the same from its exported files."""
    Georeference(
        method="given",
        origin=CartesianOrigin(x=100, y=0, z=0),
        residuals_m=None,
        axes="",
        unit="",
        projection=None,
        scale=10,
        rotation=((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        translation=(-1000, 0, 0),
        residuals=(),
    ).write(results / "inspect")
    scene = splatmake.load(results)
    for suffix in (".ply", ".npz"):
        file = tmp_path / f"a{suffix}"
        scene.export(file, morton_order=False)
        ratio = scene.gaussians.means / splatmake.read_gaussians(file).means
        np.testing.assert_allclose(ratio, 10 if suffix == ".ply" else 1, rtol=1e-6)
        again = splatmake.load(results, file)
        for view in scene.views:
            ours, theirs = scene.render(view), again.render(again.view(view.name))
            assert ours.rgb.std() > 0
            np.testing.assert_allclose(ours.rgb, theirs.rgb, atol=1e-4)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda scene: scene.export("a.obj"), "a.obj: expected a file of Gaussians"),
        (lambda scene: scene.export("a.ply", sh_degree=4), "sh_degree: expected 0, 1, 2 or 3"),
        (lambda scene: scene.export("a.ply", min_opacity=2), "min_opacity: expected 0 to 1"),
        (lambda scene: scene.mesh("a.spz"), "a.spz: expected a mesh file"),
        (lambda scene: scene.mesh("a.ply", voxel=0), "voxel: expected a length above 0"),
        (lambda scene: scene.view("9"), "barn: expected a view named '9', found 3 others"),
    ],
)
def test_a_wrong_argument_is_one_error(
    call: Callable[[Scene], object], said: str, results: Path
) -> None:
    with pytest.raises(UserError, match=re.escape(said)):
        call(splatmake.load(results))
