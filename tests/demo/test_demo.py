"""Ground truth of the demo scene is consistent, in all output formats."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.config.schema import Decode
from pipeline.demo.__main__ import main
from pipeline.demo.cameras import LENSES
from pipeline.demo.scene import OBJECTS
from pipeline.demo.shapes import Box, Cylinder, Shape, Sphere
from pipeline.demo.write import DemoSpec, write_demo
from pipeline.geometry.cameras import Camera
from pipeline.geometry.distortion import project, unproject
from pipeline.io.colmap import read_model
from pipeline.io.recorded import digest_of
from pipeline.photos.develop import develop
from pipeline.photos.load import load_mask, load_rgb, load_rgba
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import PosedImage, Reconstruction
from tests.plan.scans import look

SPEC = DemoSpec(
    views=4, width=160, height=120, format="png", distortion="opencv", poses="colmap", seed=3
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "scene"
    write_demo(folder, SPEC)
    return folder


def load(folder: Path) -> tuple[Camera, list[PosedImage], list[np.ndarray], list[np.ndarray]]:
    """The camera, poses, pictures and depth maps."""
    model = read_model(folder / "sparse_gt")
    views = sorted(model.images.values(), key=lambda image: image.name)
    pictures = [load_rgb(folder / "images" / view.name) for view in views]
    depths = [np.load(folder / "depth_gt" / f"{Path(v.name).stem}.npy") for v in views]
    return model.cameras[1], views, pictures, depths


def to_world(camera: Camera, view: PosedImage, xy: np.ndarray, z: np.ndarray) -> np.ndarray:
    flat = unproject(camera, xy)
    local = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1) * z[..., None]
    return np.asarray((local - view.translation) @ view.rotation)


def to_view(camera: Camera, view: PosedImage, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    local = xyz @ view.rotation.T + view.translation
    return project(camera, local[..., :2] / local[..., 2:]), local[..., 2]


def test_the_plan_knows_every_file_of_the_scene(folder: Path) -> None:
    """The truth and the specification are no inputs, and nobody has to be warned of them."""
    found = look(folder)
    assert found.unused == () and len(found.photos) == 4


def test_depth_reprojects_one_view_onto_another(folder: Path) -> None:
    camera, views, pictures, depths = load(folder)
    x, y = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    for first, second in ((0, 1), (2, 1)):
        xyz = to_world(camera, views[first], np.stack([x, y], -1), depths[first].astype(float))
        xy, z = to_view(camera, views[second], xyz)
        at = (xy - 0.5).astype(np.float32)
        colour = cv2.remap(pictures[second], at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        depth = cv2.remap(depths[second], at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        same = np.abs(depth - z) < 0.01 * z
        assert same.mean() > 0.5  # most of the picture is seen from both
        difference = np.abs(colour.astype(float) - pictures[first])[same]
        assert np.median(difference) < 5
        # Any other alignment is worse: the truth is not off by a fraction of a pixel.
        for shift in ((0.5, 0.0), (0.0, 0.5), (-0.5, 0.0), (0.0, -0.5)):
            moved = cv2.remap(
                pictures[second],
                at[..., 0] + np.float32(shift[0]),
                at[..., 1] + np.float32(shift[1]),
                cv2.INTER_LINEAR,
            )
            worse = np.abs(moved.astype(float) - pictures[first])[same]
            assert np.mean(worse**2) > np.mean(difference**2)


def test_depth_is_that_of_the_known_ball(folder: Path) -> None:
    camera, views, _, depths = load(folder)
    ball = OBJECTS[1].shape
    assert isinstance(ball, Sphere)
    for view, depth in zip(views, depths, strict=True):
        centre = np.array(ball.centre)
        towards = view.centre - centre
        nearest = centre + ball.radius * towards / np.linalg.norm(towards)
        xy, z = to_view(camera, view, nearest)
        column, row = xy.astype(int)
        # Nothing stands before the ball on the pedestal, and its nearest point is flat on.
        assert abs(depth[row, column] - z) < 0.003


def test_given_points_lie_on_the_surfaces_that_their_views_see(folder: Path) -> None:
    camera = load(folder)[0]
    model = read_model(folder / "sparse" / "0")
    points = model.points
    assert len(points) > 100 and points.track_length.min() >= 2
    owner = np.repeat(np.arange(len(points)), points.track_length)
    for number, image in model.images.items():
        here = points.track_image_id == number
        xy, z = to_view(camera, image, points.xyz[owner[here]])
        np.testing.assert_allclose(xy, points.track_xy[here], atol=1e-6)
        column, row = xy.astype(int).T
        stem = Path(image.name).stem
        depth = np.load(folder / "depth_gt" / f"{stem}.npy")[row, column]
        assert np.all(np.abs(depth - z) < 0.02 * z)


def test_same_bytes_at_any_number_of_processes(tmp_path: Path) -> None:
    noisy = DemoSpec(views=3, width=48, height=36, format="dng", noise=5.0, poses="transforms")
    masked = DemoSpec(views=3, width=48, height=36, masks=True)
    for spec in (noisy, masked):
        for processes in (1, 2):
            write_demo(tmp_path / str(processes), spec, processes)
        one, two = (
            {p.relative_to(tmp_path / n): p.read_bytes() for p in (tmp_path / n).rglob("*.*")}
            for n in ("1", "2")
        )
        assert one == two and len(one) > 9


def test_raw_and_jpeg_show_what_the_png_shows(folder: Path, tmp_path: Path) -> None:
    _, _, pictures, _ = load(folder)
    write_demo(tmp_path / "jpg", replace(SPEC, format="jpg"))
    for i, picture in enumerate(pictures):
        jpeg = load_rgb(tmp_path / "jpg" / "images" / f"view_{i:03d}.jpg")
        assert np.sqrt(np.mean((jpeg.astype(float) - picture) ** 2)) < 4
    exif = Image.open(tmp_path / "jpg" / "images" / "view_000.jpg").getexif().get_ifd(0x8769)
    camera = read_model(tmp_path / "jpg" / "sparse_gt").cameras[1]
    by_diagonal = exif[41989] / np.hypot(36, 24) * np.hypot(160, 120)
    assert by_diagonal == pytest.approx(camera.params[0], rel=0.02)  # whole millimetres
    assert float(exif[37386]) * float(exif[41486]) / 10 == pytest.approx(camera.params[0], 1e-3)

    write_demo(tmp_path / "dng", replace(SPEC, format="dng"))
    paths = sorted((tmp_path / "dng" / "images").iterdir())
    photos = [
        Photo(name=p.name, path=str(p), width=160, height=120, digest=digest_of(p), linear=True)
        for p in paths
    ]
    manifest = Manifest(scene="demo", photos=tuple(photos))
    report = develop(manifest, Decode(), tmp_path / "out", threads=2)
    for photo, picture in zip(report.manifest.photos, pictures, strict=True):
        error = (load_rgb(photo.path).astype(float) - picture)[4:-4, 4:-4]
        assert np.sqrt(np.mean(error**2)) < 8  # tiny pictures are hard to demosaic
        assert np.all(np.abs(error.mean(axis=(0, 1))) < 0.5)  # no cast, no change of exposure


@pytest.mark.parametrize("distortion", LENSES)
def test_transforms_equal_the_ground_truth(tmp_path: Path, distortion: str) -> None:
    height = 16 if distortion == "equirectangular" else 24
    spec = DemoSpec(
        views=2, width=32, height=height, distortion=distortion, poses="transforms", format="png"
    )
    write_demo(tmp_path / "s", spec)
    told = json.loads((tmp_path / "s" / "transforms.json").read_text())
    truth = read_model(tmp_path / "s" / "sparse_gt")
    for frame in told["frames"]:
        view = truth.by_name()[Path(frame["file_path"]).name]
        pose = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(pose[:3, 3], view.centre, atol=1e-9)
        np.testing.assert_allclose(-pose[:3, 2], view.rotation[2], atol=1e-9)  # looks along -z
        np.testing.assert_allclose(pose[:3, 1], -view.rotation[1], atol=1e-9)  # y up
    if distortion == "equirectangular":
        assert (told["camera_model"], told["w"], told["h"]) == ("EQUIRECTANGULAR", 32, 16)
        return
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2") + (
        ("k3", "k4") if "fisheye" in distortion else ("p1", "p2")
    )
    same = Camera(told["camera_model"], 32, 24, np.array([told[name] for name in names]))
    flat = np.array([[0.1, 0.2], [-0.3, 0.25], [0.4, -0.3]])
    np.testing.assert_allclose(project(same, flat), project(truth.cameras[1], flat), atol=1e-9)


def test_masks_hide_the_visitor_and_nothing_else(folder: Path, tmp_path: Path) -> None:
    _, _, pictures, _ = load(folder)
    write_demo(tmp_path / "s", replace(SPEC, masks=True))
    for i, plain in enumerate(pictures):
        mask = load_mask(tmp_path / "s" / "masks" / f"view_{i:03d}.png")
        visited = load_rgb(tmp_path / "s" / "images" / f"view_{i:03d}.png")
        assert 0.01 < 1 - mask.mean() < 0.3
        assert np.abs(visited.astype(int) - plain)[mask].max() <= 1
        assert np.abs(visited.astype(int) - plain)[~mask].mean() > 10
        depth = f"depth_gt/view_{i:03d}.npy"
        assert (folder / depth).read_bytes() == (tmp_path / "s" / depth).read_bytes()


def test_alpha_covers_the_objects_alone(folder: Path, tmp_path: Path) -> None:
    _, views, pictures, _ = load(folder)
    write_demo(tmp_path / "s", replace(SPEC, alpha=True, poses="none"))
    for view, plain in zip(views, pictures, strict=True):
        rgb, alpha = load_rgba(tmp_path / "s" / "images" / view.name)
        assert alpha is not None and 0.05 < (alpha == 255).mean() < 0.6
        assert np.abs(rgb.astype(int) - plain)[alpha == 255].max() <= 1
        depth = np.load(tmp_path / "s" / "depth_gt" / f"{Path(view.name).stem}.npy")
        assert not depth[alpha == 0].any() and depth[alpha == 255].all()


@pytest.mark.parametrize(
    "shape",
    [Sphere((0.1, 0.2, 0.3), 0.4), Cylinder((0.1, 0.2), 0.3, -0.1, 0.5)]
    + [Box((0.1, 0.2, 0.3), (0.3, 0.2, 0.4), 0.6, inside) for inside in (False, True)],
)
def test_rays_end_on_surfaces_whose_normals_face_them(shape: Shape) -> None:
    rng = np.random.default_rng(0)
    inside = isinstance(shape, Box) and shape.inside
    origin = rng.normal(size=(3, 500)) * (0.05 if inside else 1.0)
    if inside:
        origin += np.array([[0.1], [0.2], [0.3]])
    else:
        origin *= 2 / np.linalg.norm(origin, axis=0)
    aim = rng.uniform(-0.2, 0.2, (3, 500)) + np.array([[0.1], [0.2], [0.25]])
    direction = (aim - origin) * rng.uniform(0.3, 3, 500)
    t = shape.hit(origin, direction)
    hit = np.isfinite(t)
    assert hit.mean() > 0.8
    point = (origin + np.where(hit, t, 0) * direction)[:, hit]
    normal = shape.normal(point)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=0), 1, atol=1e-6)
    assert np.all((normal * direction[:, hit]).sum(0) < 0)
    # Just before the hit the ray has not met the surface, just behind it has.
    behind = shape.hit(point - 1e-3 * direction[:, hit], direction[:, hit])
    np.testing.assert_allclose(behind, 1e-3, rtol=1e-6)


def test_incompatible_options_and_foreign_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / "a"), "--alpha"]) == 2
    assert "has no alpha" in capsys.readouterr().err
    with pytest.raises(UserError, match="even sides"):
        write_demo(tmp_path / "a", DemoSpec(width=33, height=24, format="dng"))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "holiday.jpg").write_bytes(b"")
    with pytest.raises(UserError, match="no demo scene"):
        write_demo(tmp_path / "mine", DemoSpec(views=1, width=32, height=24))
    assert not (tmp_path / "a").exists() and (tmp_path / "mine" / "holiday.jpg").exists()
    small = [str(tmp_path / "b"), "--views", "1", "--size", "32x24", "--processes", "1"]
    assert main(small) == 0 and main(small) == 0  # a demo scene may be written over
    assert json.loads((tmp_path / "b" / "demo.json").read_text())["views"] == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spec", "degrees"),
    [
        (DemoSpec(views=16, width=200, height=150), 0.5),
        (DemoSpec(views=12, width=320, height=240), 0.2),
    ],
)
def test_sfm_registers_every_view_of_a_tiny_scene(
    tmp_path: Path, spec: DemoSpec, degrees: float
) -> None:
    from pipeline.metrics.pose import pose_error

    write_demo(tmp_path / "s", spec)
    # A process of its own: pycolmap's libpng must not meet cv2's.
    script = """
import sys, pycolmap
images, work = sys.argv[1:]
pycolmap.extract_features(work + "/db.db", images, camera_mode=pycolmap.CameraMode.SINGLE)
pycolmap.match_exhaustive(work + "/db.db")
models = pycolmap.incremental_mapping(work + "/db.db", images, work)
best = max(models.values(), key=lambda model: model.num_reg_images())
best.write_text(work)
"""
    command = [sys.executable, "-c", script, str(tmp_path / "s" / "images"), str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True)
    found: Reconstruction = read_model(tmp_path)
    error = pose_error(found, read_model(tmp_path / "s" / "sparse_gt"))
    assert error.num_common == error.num_truth == spec.views
    assert error.rotation_median_deg is not None and error.rotation_median_deg < degrees
