"""``python -m pipeline``: models by whatever program are measured, rendered and converted."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.command.main import main
from pipeline.config.schema import Config
from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import write_model
from pipeline.io.ply import write_splat_ply
from pipeline.io.recorded import digest_of
from pipeline.io.splat_files import read_gaussians
from pipeline.io.transforms import write_transforms
from pipeline.plan.values import StagePlan
from pipeline.render import RasterOptions
from pipeline.render.views import near_plane, render_view, to_bytes
from pipeline.runtime.atomic import write_json
from pipeline.runtime.record import StageRecord
from pipeline.scene.exposure import NO_GAINS
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import PosedImage, Reconstruction
from pipeline.scene.views import camera_views, scene_extent
from pipeline.splats.gaussians import Gaussians
from tests.plans import record_of
from tests.splats.samples import sample

SIZE = 48
PINHOLE = Camera("PINHOLE", SIZE, SIZE, np.array([50.0, 50, 24, 24]))


def cameras(prefix: str = "", camera: Camera = PINHOLE) -> Reconstruction:
    images = {
        i + 1: PosedImage(f"{prefix}p{i}.png", 1, np.eye(3), np.array([0.5 * i - 0.5, 0, 8.0]))
        for i in range(3)
    }
    return Reconstruction({1: camera}, images)


def blobs(degree: int) -> Gaussians:
    gaussians = sample(60, degree, seed=4)
    gaussians.log_scales.clamp_(-3, -1)
    return gaussians


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene whose photographs are renders of model.ply: measured, it is perfect."""
    write_splat_ply(tmp_path / "model.ply", blobs(3))
    photograph(tmp_path / "scene", blobs(3))
    return tmp_path


def photograph(scene: Path, gaussians: Gaussians) -> None:
    write_model(scene / "sparse" / "0", cameras())
    (scene / "images").mkdir(parents=True, exist_ok=True)
    views = camera_views(cameras(), None)
    for view in views:
        picture = render_view(gaussians, view, RasterOptions(near=near_plane(scene_extent(views))))
        Image.fromarray(to_bytes(picture.rgb)).save(scene / "images" / view.name)


def run(*arguments: str | Path) -> int:
    return main([str(argument) for argument in arguments])


def measured(model: Path, scene: Path, *more: str) -> dict:
    out = model.parent / "out"
    assert run("evaluate", model, "--scene", scene, "-o", out, *more) == 0
    found = json.loads((out / "evaluation.json").read_text())
    assert len(list((out / "renders").iterdir())) == len(found["per_view"])
    return found


def as_others_write(source: Path, target: Path) -> None:
    """The same Gaussians without normals, in another order, with a comment."""
    head, body = source.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2].decode() for line in head.splitlines() if line[:8] == b"property"]
    table = np.frombuffer(body, "<f4").reshape(-1, len(names))
    kept = sorted((n for n in names if n not in ("nx", "ny", "nz")), reverse=True)
    lines = ["ply", "comment made elsewhere", "format binary_little_endian 1.0"]
    lines += [f"element vertex {len(table)}", *(f"property float {n}" for n in kept), "end_header"]
    columns = [names.index(n) for n in kept]
    target.write_bytes("\n".join([*lines, ""]).encode() + table[:, columns].tobytes())


def test_a_model_of_the_originals_layout_is_measured(folder, capsys):
    found = measured(folder / "model.ply", folder / "scene")
    assert found["psnr"] == 100 and found["ssim"] == pytest.approx(1)
    assert [view["name"] for view in found["per_view"]] == ["p0.png"]
    assert "one view in 8" in found["protocol"]["split"]
    shown = capsys.readouterr().out
    assert "p0.png  100.00 dB" in shown and "PSNR 100.00 dB" in shown


def test_a_model_without_normals_is_measured_and_converted(folder):
    as_others_write(folder / "model.ply", folder / "other.ply")
    assert measured(folder / "other.ply", folder / "scene")["psnr"] == 100
    assert run("convert", folder / "other.ply", folder / "back.ply") == 0
    assert (folder / "back.ply").read_bytes() == (folder / "model.ply").read_bytes()


def test_a_model_of_degree_0_is_measured_and_converted(folder):
    write_splat_ply(folder / "flat.ply", blobs(0))
    photograph(folder / "scene", blobs(0))
    found = measured(folder / "flat.ply", folder / "scene")
    assert found["psnr"] == 100 and found["model"]["sh_degree"] == 0
    for suffix in (".spz", ".sog", ".glb", ".npz"):
        assert run("convert", folder / "flat.ply", folder / f"flat{suffix}") == 0
        assert measured(folder / f"flat{suffix}", folder / "scene")["psnr"] > 45


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".glb", ".npz"])
def test_a_converted_model_looks_the_same(folder, suffix):
    target = folder / f"model{suffix}"
    assert run("convert", folder / "model.ply", target, "--morton-order") == 0
    assert measured(target, folder / "scene")["psnr"] > 45


def test_conversion_leaves_out_what_it_is_told_to(folder, capsys):
    target = folder / "small.spz"
    options = ["--sh-degree", "1", "--min-opacity", "0.5"]
    assert run("convert", folder / "model.ply", target, *options) == 0
    found = read_gaussians(target, [])
    assert found.sh_degree == 1
    assert len(found) == int((blobs(3).opacity_logits >= 0).sum())
    assert f"{len(found)} written" in capsys.readouterr().out


def test_all_views_and_their_size_are_a_matter_of_choice(folder):
    found = measured(folder / "model.ply", folder / "scene", "--every", "0", "--max-side", "24")
    assert len(found["per_view"]) == 3 and found["protocol"]["resolution"] == ["24x24"]


def test_a_finished_scene_brings_its_settings(folder, monkeypatch, capsys):
    """Photographs that no stage copied are found from another working directory, too."""
    project = folder / "project"
    scene = project / "results" / "NAME"
    (project / "data").mkdir(parents=True)
    (folder / "scene" / "images").rename(project / "data" / "images")
    photos = [
        Photo(
            name=f"p{i}.png",
            path=f"data/images/p{i}.png",
            width=SIZE,
            height=SIZE,
            digest=digest_of(project / "data" / "images" / f"p{i}.png"),
        )
        for i in range(3)
    ]
    Manifest(scene="NAME", photos=tuple(photos)).write(scene / "inspect" / "images.json")
    write_model(scene / "inspect" / "sparse" / "0", cameras())
    stages = {"inspect": True, "undistort": False}
    plan = record_of({name: StagePlan(run=run, reason="") for name, run in stages.items()})
    (scene / "plan.json").write_text(plan.model_dump_json())
    config = Config().model_dump(mode="json")
    config["split"]["test_every"], config["train"]["background"] = 2, "black"
    (scene / "train").mkdir()
    key = {"config": {name: config[name] for name in ("views", "split", "train")}}
    write_json(
        scene / "train" / "stage.json",
        StageRecord(
            stage="train",
            scene="NAME",
            key=key,
            inputs={},
            outputs={},
            counters={},
            decisions=(),
            warnings=(),
        ).model_dump(mode="json"),
    )
    NO_GAINS.write(scene / "train")
    (folder / "elsewhere").mkdir()
    monkeypatch.chdir(folder / "elsewhere")
    found = measured(folder / "model.ply", scene)
    assert [view["name"] for view in found["per_view"]] == ["p0.png", "p2.png"]
    assert found["psnr"] == 100
    (scene / "plan.json").write_text('{"version": 2}')
    assert run("evaluate", folder / "model.ply", "--scene", scene) == 2
    said = capsys.readouterr().err
    assert f"{scene}/plan.json: cannot be read" in said and "--forcerun plan" in said
    assert "Traceback" not in said


def test_renders_are_named_as_the_views(folder, capsys):
    out = folder / "renders"
    assert run("render", folder / "model.ply", "--cameras", folder / "scene", "-o", out) == 0
    assert sorted(path.name for path in out.iterdir()) == ["p0.png", "p1.png", "p2.png"]
    for path in out.iterdir():
        photo = Image.open(folder / "scene" / "images" / path.name)
        np.testing.assert_array_equal(Image.open(path), photo)


def test_one_view_from_transforms_json_without_photographs(folder):
    views = camera_views(cameras(), None)
    views = [replace(view, image=str(folder.parent / "pictures" / view.name)) for view in views]
    write_transforms(folder / "transforms.json", views, folder)
    for view in (folder / "scene" / "images").iterdir():
        view.rename(folder / view.name)
    out = folder / "out"
    where = folder / "transforms.json"
    arguments = ["--cameras", where, "-o", out, "--view", "p1"]
    assert run("render", folder / "model.ply", *arguments) == 0
    (picture,) = out.iterdir()
    np.testing.assert_array_equal(Image.open(picture), Image.open(folder / "p1.png"))


def test_views_are_written_inside_the_folder_whatever_their_names(folder):
    model = cameras()
    names = ["../../a.png", "/abs/b.jpg", "/abs/b.png"]
    images = {
        i: PosedImage(name, 1, image.rotation, image.translation)
        for (i, image), name in zip(model.images.items(), names, strict=True)
    }
    write_model(folder / "odd", Reconstruction(model.cameras, images))
    out = folder / "deep" / "er" / "out"
    assert run("render", folder / "model.ply", "--cameras", folder / "odd", "-o", out) == 0
    written = sorted(p.relative_to(out).as_posix() for p in out.rglob("*.png"))
    assert written == ["a.png", "abs/b.png", "abs/b.png.png"]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def lie(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"vertex 60", b"vertex 6000000000", 1))


def forget(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"property float opacity\n", b"", 1))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (cut, "of 60 Gaussians after the header, found"),
        (lie, "of 6000000000 Gaussians"),
        (forget, "no opacity"),
        (Path.unlink, "no such file"),
    ],
)
@pytest.mark.parametrize("command", ["convert", "render", "evaluate"])
def test_a_damaged_model_is_one_clear_error(folder, capsys, damage, message, command):
    model, out = folder / "model.ply", folder / "out.spz"
    damage(model)
    arguments = {
        "convert": [model, out],
        "render": [model, "--cameras", folder / "scene", "-o", out],
        "evaluate": [model, "--scene", folder / "scene", "-o", out],
    }[command]
    assert run(command, *arguments) == 2
    shown = capsys.readouterr().err
    assert shown.startswith(f"error: {model}: ") and message in shown
    assert shown.count("\n") == 2 and "Traceback" not in shown
    assert not out.exists()


def test_wrong_surroundings_are_one_clear_error(folder, capsys):
    model, scene = folder / "model.ply", folder / "scene"
    bent = Camera("SIMPLE_RADIAL", SIZE, SIZE, np.array([50.0, 24, 24, 0.1]))
    for arguments, message in [
        (["convert", model, folder / "a.obj"], r"found the suffix '.obj'"),
        (["convert", model, folder / "a.ply", "--min-opacity", "1"], "opacity below 1.0"),
        (["render", model, "--cameras", folder, "-o", folder / "o"], "COLMAP model"),
        (["render", model, "--cameras", scene, "-o", folder / "o", "--view", "x"], "named 'x'"),
        (["evaluate", model, "--scene", folder / "none"], "no such file"),
    ]:
        assert run(*arguments) == 2
        assert message in capsys.readouterr().err
    write_model(scene / "sparse" / "0", cameras(camera=bent))
    assert run("evaluate", model, "--scene", scene) == 2
    assert "lens distortion" in capsys.readouterr().err
    assert run("render", model, "--cameras", scene, "-o", folder / "o") == 0
    assert "warning: " in (shown := capsys.readouterr().err) and "lens distortion" in shown
    for file in (scene / "sparse" / "0").iterdir():
        file.unlink()
    assert run("evaluate", model, "--scene", scene) == 2
    assert "found no poses" in capsys.readouterr().err
    (scene / "plan.json").write_text("{}")
    assert run("evaluate", model, "--scene", scene) == 2
    assert "finished scene" in capsys.readouterr().err


def test_help_is_there_at_once():
    code = (
        "import sys\nfrom pipeline.command.main import main\n"
        "try:\n    main(['evaluate', '--help'])\nfinally:\n    assert 'torch' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "--scene" in done.stdout and "results/NAME" in done.stdout
