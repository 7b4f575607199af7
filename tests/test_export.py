"""The export stage: every format, and ``frame.json``."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import tifffile
from PIL import Image

from pipeline.config.export import RENDERED_FORMATS, SURVEY_FORMATS, ExportFormat
from pipeline.config.settled import Config
from pipeline.config.video import VideoExport
from pipeline.export.counters import ExportCounters
from pipeline.export.write import WRITERS
from pipeline.geometry.cameras import Camera
from pipeline.io.camera_files import read_cameras
from pipeline.io.colmap import read_model, write_model
from pipeline.io.npz import write_npz
from pipeline.io.recorded import digest_of
from pipeline.io.splat_files import is_antialiased, read_gaussians
from pipeline.io.transforms import read_frames, read_transforms
from pipeline.mvs.maps import DenseCloud, DenseMap, write_dense_cloud, write_map
from pipeline.photos.found_masks import write_found
from pipeline.photos.load import load_mask
from pipeline.plan.given_poses import GivenModel
from pipeline.runtime.errors import UserError
from pipeline.runtime.job import Job
from pipeline.scene.blocks import Block, Partition
from pipeline.scene.exposure import NO_GAINS
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.normalization import Normalization
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from stages.export import work
from tests.splats.samples import sample

FORMATS = get_args(ExportFormat)
ROLES = ("views", "model", "poses", "inspect", "photos")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """results/NAME with the inputs of the export: images of 90x60 with a camera of 180x120, as if
    the poses were given for larger photographs."""
    scene = tmp_path / "results" / "NAME"
    camera = Camera("PINHOLE", 180, 120, np.array([100.0, 100, 90, 60]))
    images = {
        i + 1: PosedImage(f"p{i}.png", 1, np.eye(3), np.array([float(i), 0, 4])) for i in range(9)
    }
    points = Points(
        np.array([[0.0, 1, 2]]),
        np.array([[255, 0, 9]], np.uint8),
        np.array([0.5]),
        np.array([0, 1]),
        np.array([1]),
        np.array([[3.5, 4.5]]),
    )
    write_model(scene / "undistort" / "sparse" / "0", Reconstruction({1: camera}, images, points))
    (scene / "undistort" / "images").mkdir()
    photos = []
    for i in range(9):
        path = scene / "undistort" / "images" / f"p{i}.png"
        Image.new("RGB", (90, 60), (90, 80, 70)).save(path)
        photos.append(
            Photo(name=path.name, path=str(path), width=90, height=60, digest=digest_of(path))
        )
    Manifest(scene="NAME", photos=tuple(photos)).write(scene / "undistort" / "images.json")
    (scene / "train").mkdir()
    write_npz(scene / "train" / "gaussians.npz", sample(50))
    NO_GAINS.write(scene / "train")
    up = np.array([[0.0, 0.0, 1.0]], np.float32)
    cloud = DenseCloud(np.array([[0, 1, 2]], np.float32), up, np.array([[1, 2, 3]], np.uint8))
    write_dense_cloud(scene / "dense", cloud)
    person = np.zeros((60, 90), bool)
    person[20:40, 30:45] = True
    write_found(scene / "train" / "transients", {"p3.png": person})
    depth = np.full((60, 90), 2.0, np.float32)
    normals = np.broadcast_to(-up[0], (60, 90, 3)).astype(np.float32)
    for i in range(1, 8):  # p0 and p8 are test views
        write_map(scene / "dense", f"p{i}.png", DenseMap(depth, normals, depth / 2))
    return scene


def export(scene: Path, antialias: bool = False, **options) -> tuple[Path, Job]:
    config = Config().model_dump(mode="json")
    for name, value in options.items():
        where = config if name in config["export"] else config["experiments"]
        where["export"][name] = value
    config["train"] |= {"background": "random", "antialias": antialias}
    out = scene / ".scratch" / "out"
    job = Job(
        stage="export",
        scene="NAME",
        key={"seed": 0, "config": config},
        inputs={role: scene / "undistort" for role in ROLES}
        | {
            name: scene / name
            for name in ("train", "dense", "partition")
            if (scene / name).is_dir()
        },
        out=out,
        scratch=out.parent,
        shared_cache=out.parent,
        threads=1,
        memory_mb=None,
        logs=out.parent,
    )
    work(job)
    final = scene / "export"
    out.rename(final)
    return final, job


def test_every_format_the_schema_offers_is_written(scene):
    assert set(WRITERS) | RENDERED_FORMATS | SURVEY_FORMATS == set(FORMATS)
    out, job = export(
        scene, formats=list(WRITERS), sh_degree=1, min_opacity=0.3, morton_order=False
    )
    kept = sample(50).select(sample(50).opacity_logits.sigmoid() >= 0.3)
    assert isinstance(job.counters, ExportCounters)
    assert job.counters.exported_gaussians == len(kept)
    files = ((".ply", 1), (".spz", 1), ("_v4.spz", 1), (".sog", 1), (".glb", 1), (".splat", 0))
    for suffix, degree in files:
        found = read_gaussians(out / f"point_cloud{suffix}", [])
        assert len(found) == len(kept) and found.sh_degree == degree
        coarse = 5e-4 if suffix == ".sog" else 1e-5
        np.testing.assert_allclose(found.means, kept.means, rtol=0, atol=coarse)
    assert json.loads((out / "sog_lod" / "lod-meta.json").read_text())["counts"][0] == len(kept)
    for folder in ("sparse/0", "sparse_text"):
        model = read_model(out / folder)
        assert len(model.images) == 9 and len(model.points) == 1
    assert (out / "sparse_text" / "cameras.txt").is_file()
    for name in ("points.ply", "dense_points.ply"):
        assert b"element vertex 1\n" in (out / name).read_bytes()[:100]
    assert b"property float nx" in (out / "dense_points.ply").read_bytes()
    maps = sorted(path.name for path in (out / "dense_maps").iterdir())
    assert maps == [f"p{i}.tiff" for i in range(1, 8)]
    [mask] = (out / "masks").iterdir()
    assert mask.name == "p3.png" and (~load_mask(str(mask))).sum() == 20 * 15


GIVEN = Normalization(0.001, np.array([4e6, 5e5, 300.0]))


@pytest.fixture
def far_scene(scene: Path) -> Path:
    """The scene with given poses in millimetres, thousands of kilometres from their origin."""
    folder = scene / "undistort"
    model = read_model(folder / "sparse" / "0")
    georeference = GivenModel(model, GIVEN).georeference()
    assert georeference is not None
    georeference.write(folder)
    return scene


@pytest.mark.parametrize("blocks", [1, 2])
def test_each_gaussian_is_in_the_file_of_its_block(far_scene, blocks):
    """Faces of blocks are in the unit of training, the files in that of the given poses."""
    means = sample(50).means.numpy()
    face = float(np.median(means[:, 0]))
    if blocks == 2:
        divided_at(face).write(far_scene / "partition")
    out, _ = export(far_scene, formats=["blocks"], min_opacity=0.3)
    shown = sample(50).opacity_logits.sigmoid().numpy() >= 0.3
    below = shown & (means[:, 0] < face)
    expected = [shown] if blocks == 1 else [below, shown & ~below]
    files = [out / "blocks" / f"block_{number}.ply" for number in range(1, blocks + 1)]
    assert sorted((out / "blocks").iterdir()) == files
    for file, rows in zip(files, expected, strict=True):
        found = np.sort(read_gaussians(file, []).means[:, 0])
        np.testing.assert_allclose(found, np.sort(1000 * means[rows, 0]), rtol=1e-5)


def divided_at(face: float) -> Partition:
    """Two blocks on both sides of ``x == face``."""
    common = {
        "margin_below": (0, 0, 0),
        "margin_above": (0, 0, 0),
        "gaussians": 1,
        "max_gaussians": 1,
        "steps": 1,
        "views": (),
        "overviews": (),
    }
    everything = (None, None, None)
    return Partition(
        axes=np.eye(3).tolist(),
        lower=(-1, -1, -1),
        upper=(1, 1, 1),
        blocks=(
            Block(lower=everything, upper=(face, None, None), **common),
            Block(lower=(face, None, None), upper=everything, **common),
        ),
    )


def test_cameras_and_points_are_exported_in_the_given_world(far_scene):
    formats = ["colmap", "transforms", "points", "ply", "dense_points", "dense_maps"]
    out, _ = export(far_scene, formats=formats)
    local = read_model(far_scene / "undistort" / "sparse" / "0")
    expected = GIVEN.model_to_given(local).by_name()
    for found in (read_model(out / "sparse" / "0"), read_cameras_without_origin(out)):
        for image in found.images.values():
            truth = next(v for k, v in expected.items() if image.name.endswith(k))
            np.testing.assert_allclose(image.centre, truth.centre, rtol=1e-12)
    depth = tifffile.imread(out / "dense_maps" / "p1.tiff")
    assert depth.dtype == np.float32 and depth.shape == (60, 90)
    np.testing.assert_allclose(depth, 2000.0, rtol=1e-5)  # in the given unit
    dense = (out / "dense_points.ply").read_bytes().split(b"end_header\n")[1]
    expected_xyz = GIVEN.to_given(np.array([0.0, 1.0, 2.0]))
    np.testing.assert_allclose(np.frombuffer(dense[:24], "<f8"), expected_xyz, rtol=1e-12)
    header, body = (out / "points.ply").read_bytes().split(b"end_header\n")
    assert b"property double x" in header
    xyz = np.frombuffer(body[:24], "<f8")
    np.testing.assert_allclose(xyz, GIVEN.to_given(local.points.xyz[0]), rtol=1e-15)


def read_cameras_without_origin(out: Path) -> Reconstruction:
    frames = read_frames(out / "transforms.json")
    return read_transforms(out / "transforms.json", {frame.name: (180, 120) for frame in frames})


def test_gaussians_are_exported_in_the_given_unit_near_the_origin(far_scene):
    out, _ = export(far_scene, formats=["ply", "colmap"], morton_order=False)
    trained, found = sample(50), read_gaussians(out / "point_cloud.ply", [])
    np.testing.assert_allclose(found.means, trained.means * 1000, rtol=1e-6)
    np.testing.assert_allclose(found.log_scales, trained.log_scales + np.log(1000), atol=1e-6)
    frame = json.loads((out / "frame.json").read_text())
    assert frame["unit"] == "that of the given camera poses"
    assert list(frame["georeference"]["origin"].values()) == GIVEN.origin.tolist()
    assert "origin" in frame["axes_of"]["sparse/0"]
    assert "point_cloud.ply" not in frame["axes_of"]
    # The program's own renderer shows the Gaussians from these cameras.
    local = read_model(far_scene / "undistort" / "sparse" / "0")
    for image in read_cameras(out).images.values():
        centre = local.by_name()[image.name].centre
        np.testing.assert_allclose(image.centre, centre * 1000, atol=1e-5)


def test_rendered_formats_are_written_on_demand(scene):
    video = VideoExport(seconds=1).model_dump()
    out, job = export(scene, formats=["renders", "depths", "mesh", "video"], video=video)
    assert len(list((out / "renders").glob("*.png"))) == 9
    assert len(list((out / "depths" / "median").iterdir())) == 9
    assert (out / "path.json").is_file()
    # Fifty scattered Gaussians have no surface, or a poor one: either way it is said.
    assert (out / "mesh.ply").is_file() == any("mesh" in text for text in job.decisions)
    assert any("mesh" in text for text in (*job.decisions, *job.warnings))


def test_formats_without_an_antialias_flag_are_named_in_a_warning(scene):
    """A viewer without opacity compensation renders such files much worse."""
    out, job = export(scene, antialias=True, formats=["ply", "spz", "gltf"])
    assert [text.split()[0] for text in job.warnings] == ["point_cloud.glb"]
    assert all(is_antialiased(out / f"point_cloud.{suffix}") for suffix in ("ply", "spz"))
    assert json.loads((out / "frame.json").read_text())["render"]["antialias"]


def test_transforms_paths_are_relative_to_the_final_folder(scene):
    out, _ = export(scene, formats=["transforms", "points"])
    frames = read_frames(out)
    assert [(out / frame.name).resolve().is_file() for frame in frames] == [True] * 9
    model = read_transforms(out, {frame.name: (90, 60) for frame in frames})
    (camera,) = model.cameras.values()
    # Of the pictures as they are, not as the model's cameras say.
    assert (camera.width, camera.pinhole) == (90, (50, 50, 45, 30))
    content = json.loads((out / "transforms.json").read_text())
    assert len(content["test_filenames"]) == 2 and content["ply_file_path"] == "points.ply"


def test_the_loss_of_each_compressed_file_is_measured(scene):
    out, job = export(scene, formats=["ply", "spz", "sog", "splat", "gltf"])
    found = {loss.file: loss for loss in job.counters.losses}
    assert list(found) == ["point_cloud.spz", "point_cloud.sog", "point_cloud.splat"]
    for name, loss in found.items():
        assert loss.size_mb == pytest.approx((out / name).stat().st_size / 1e6, abs=5e-4)
    # Few Gaussians have a palette with an entry each; .splat drops the harmonics.
    assert found["point_cloud.spz"].psnr > 40 and found["point_cloud.sog"].psnr > 40
    assert found["point_cloud.splat"].psnr < 35


def test_the_loss_of_large_scenes_is_not_measured_and_that_is_said(scene, monkeypatch):
    monkeypatch.setattr("pipeline.export.write.MAX_MEASURED_LOSSES", 49)
    out, job = export(scene, formats=["ply", "spz"])
    assert (out / "point_cloud.spz").is_file() and not job.counters.losses
    assert any("not measured above 49 Gaussians" in text for text in job.decisions)


def test_exact_files_have_no_measured_loss(scene):
    _, job = export(scene, formats=["ply", "gltf"])
    assert job.counters == ExportCounters(exported_gaussians=50, losses=[])


def test_transforms_omit_an_empty_point_cloud(scene):
    """Given poses may have no points."""
    folder = scene / "undistort" / "sparse" / "0"
    write_model(folder, replace(read_model(folder), points=Points.empty()))
    out, _ = export(scene, formats=["transforms", "points"])
    assert "ply_file_path" not in json.loads((out / "transforms.json").read_text())


def test_frame_json_describes_the_coordinate_frame(scene):
    out, _ = export(scene, formats=["ply", "spz", "spz4", "gltf", "splat"])
    found = json.loads((out / "frame.json").read_text())
    assert found["up"] == [0, -1, 0]
    assert found["cameras"]["centre"] == [-4, 0, -4]
    assert found["gaussians"] == {"count": 50, "sh_degree": 3, "num_invented": 0}
    # Trained on random backgrounds, shown on white.
    assert found["render"]["background"] == [1, 1, 1]
    turned = {f"point_cloud{end}" for end in (".spz", "_v4.spz", ".glb")}
    assert found["axes_of"].keys() == turned


def test_default_formats(scene):
    out, _ = export(scene)
    written = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    assert written == {
        *("point_cloud.ply", "point_cloud.spz", "points.ply", "transforms.json", "frame.json"),
        *(f"sparse/0/{name}.bin" for name in ("cameras", "images", "points3D")),
    }


def test_masks_that_training_did_not_find_are_no_files(scene):
    shutil.rmtree(scene / "train" / "transients")
    out, job = export(scene, formats=["ply", "masks"])
    assert not (out / "masks").exists()
    assert "no masks: training left nothing out (train.transients)" in job.decisions


def test_pruning_everything_is_an_error(scene):
    with pytest.raises(UserError, match="have an opacity below"):
        export(scene, min_opacity=1.0)


def test_a_region_and_a_limit_hold_for_every_file(scene):
    """The box is in the unit of the exported files, and the cost is recorded."""
    means = sample(50).means.numpy()
    low, high = means.min(0), means.max(0)
    middle = float(np.median(means[:, 0]))
    box = [float(low[0]) - 1, *(low[1:] - 1).tolist(), middle, *(high[1:] + 1).tolist()]
    out, job = export(scene, formats=["ply", "spz"], region=box, max_gaussians=12)
    exported = read_gaussians(out / "point_cloud.ply", [])
    assert len(exported) == 12 == len(read_gaussians(out / "point_cloud.spz", []))
    assert exported.means[:, 0].max() <= middle
    assert job.counters.exported_gaussians == 12 and job.counters.psnr_against_all is not None
    assert json.loads((out / "frame.json").read_text())["gaussians"]["count"] == 12
    assert any("12 Gaussians of 25" in text for text in job.decisions)
