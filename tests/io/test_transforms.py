"""transforms.json: axes, intrinsics and messages."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from pipeline.geometry.distortion import project
from pipeline.geometry.rotations import quat_to_rotation
from pipeline.io.transforms import (
    find_transforms,
    read_frames,
    read_transforms,
    write_transforms,
)
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View

SIZES = {"images/a.png": (200, 100)}


def write(folder: Path, content: dict, name: str = "transforms.json") -> Path:
    file = folder / name
    file.write_text(json.dumps(content))
    return file


def frame(matrix: np.ndarray | None = None, path: str = "images/a.png", **fields) -> dict:
    matrix = np.eye(4) if matrix is None else matrix
    return {"file_path": path, "transform_matrix": matrix.tolist(), **fields}


def project_point(model: Reconstruction, point: np.ndarray) -> np.ndarray:
    (image,) = model.images.values()
    local = image.rotation @ point + image.translation
    assert local[2] > 0, "behind the camera"
    return project(model.cameras[image.camera_id], local[:2] / local[2])


def opengl_camera(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A camera to world matrix with OpenGL axes, a world point in front of it, and the point in
    the camera's own axes: (right, up, ahead)."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = quat_to_rotation(rng.normal(size=4))
    matrix[:3, 3] = rng.normal(size=3)
    right, up, ahead = 0.3, 0.2, 2.0
    point = matrix[:3] @ np.array([right, up, -ahead, 1.0])
    return matrix, point, np.array([right, up, ahead])


def test_a_known_point_projects_to_its_pixel(tmp_path):
    matrix, point, (right, up, ahead) = opengl_camera(0)
    write(tmp_path, {"fl_x": 120, "fl_y": 110, "cx": 101, "cy": 52, "frames": [frame(matrix)]})
    model = read_transforms(tmp_path, SIZES)
    # Up in OpenGL's axes is towards smaller y in the picture.
    expected = [101 + 120 * right / ahead, 52 - 110 * up / ahead]
    np.testing.assert_allclose(project_point(model, point), expected, atol=1e-9)


def test_nerf_synthetic_splits_angle_and_missing_suffix(tmp_path):
    matrix, point, (right, up, ahead) = opengl_camera(1)
    for split in ("train", "test"):
        frames = [frame(matrix, f"./{split}/r_0"), frame(matrix, f"./{split}/r_0.5")]
        write(tmp_path, {"camera_angle_x": 0.7, "frames": frames}, f"transforms_{split}.json")
    sizes = {f"{split}/r_0.png": (200, 100) for split in ("train", "test")}
    assert [file.name for file in find_transforms(tmp_path)] == [
        "transforms_train.json",
        "transforms_test.json",
    ]
    model = read_transforms(tmp_path, sizes)
    assert sorted(model.by_name()) == sorted(sizes)
    model.images.popitem()
    focal = 100 / math.tan(0.35)
    expected = [100 + focal * right / ahead, 50 - focal * up / ahead]
    np.testing.assert_allclose(project_point(model, point), expected, atol=1e-9)


@pytest.mark.parametrize("scale", [1e-6, 1e-4, 1e6])
def test_a_scale_of_any_size_is_undone(tmp_path, scale):
    pose = np.eye(4)
    pose[:3, 3] = scale * np.array([1.0, 2.0, 3.0])
    content = {"fl_x": 100, "applied_scale": scale, "frames": [frame(pose)]}
    (image,) = read_transforms(write(tmp_path, content), SIZES).images.values()
    np.testing.assert_allclose(image.centre, [1, 2, 3], rtol=1e-12)


def test_applied_transform_and_scale_are_undone(tmp_path):
    matrix, _, _ = opengl_camera(2)
    moved = np.array([[0.0, 1, 0, 3], [1, 0, 0, -2], [0, 0, -1, 5], [0, 0, 0, 1]])
    stored = moved @ matrix
    stored[:3, 3] *= 0.5
    content = {"fl_x": 100, "applied_transform": moved[:3].tolist(), "applied_scale": 0.5}
    write(tmp_path, {**content, "frames": [frame(stored)]})
    (image,) = read_transforms(tmp_path, SIZES).images.values()
    np.testing.assert_allclose(image.centre, matrix[:3, 3], atol=1e-12)
    np.testing.assert_allclose(image.rotation.T, matrix[:3, :3] @ np.diag([1, -1, -1]), atol=1e-12)


def test_each_frame_has_its_own_intrinsics(tmp_path):
    frames = [
        frame(path="images/a.png"),
        frame(path="images/b.png", fl_x=150, w=200, h=100, cx=90, cy=40, k1=0.1),
    ]
    write(tmp_path, {"fl_x": 400, "w": 400, "h": 200, "frames": frames})
    sizes = {"images/a.png": (200, 100), "images/b.png": (200, 100)}
    model = read_transforms(tmp_path, sizes)
    a, b = (model.cameras[model.by_name()[name].camera_id] for name in sorted(sizes))
    assert (a.model, a.pinhole) == ("PINHOLE", (400, 400, 200, 100))
    assert (b.model, b.params.tolist()) == ("OPENCV", [150, 150, 90, 40, 0.1, 0, 0, 0])


def test_equal_intrinsics_are_one_camera(tmp_path):
    frames = [frame(path=f"images/{i}.png") for i in range(3)]
    write(tmp_path, {"fl_x": 400, "frames": frames})
    model = read_transforms(tmp_path, {f"images/{i}.png": (20, 10) for i in range(3)})
    assert len(model.cameras) == 1 and len(model.images) == 3


@pytest.mark.parametrize(
    "fields, expected",
    [
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.2}, ("OPENCV_FISHEYE", 8)),
        ({"is_fisheye": True}, ("OPENCV_FISHEYE", 8)),
        ({"camera_model": "OPENCV", "k1": 0.1, "p2": 0.01}, ("OPENCV", 8)),
        ({"camera_model": "OPENCV", "k1": 0.0}, ("PINHOLE", 4)),
        ({"k1": 0.1, "k3": 0.2}, ("FULL_OPENCV", 12)),
        ({"camera_model": "EQUIRECTANGULAR", "w": 80, "h": 40}, ("EQUIRECTANGULAR", 2)),
    ],
)
def test_camera_models(tmp_path, fields, expected):
    write(tmp_path, {"fl_x": 400, "frames": [frame()], **fields})
    (camera,) = read_transforms(tmp_path, SIZES).cameras.values()
    assert (camera.model, len(camera.params)) == expected


def test_frames_without_photographs_are_left_out_and_suffixes_may_differ(tmp_path):
    frames = [frame(path="images/a.JPG"), frame(path="images/gone.png")]
    write(tmp_path, {"fl_x": 400, "frames": frames})
    assert list(read_transforms(tmp_path, SIZES).by_name()) == ["images/a.png"]


NAN = np.eye(4)
NAN[0, 3] = np.nan


@pytest.mark.parametrize(
    "content, message",
    [
        ('{"frames": [', "line 1, column 13"),
        ("[]", "'frames'"),
        ('{"frames": {}}', "'frames'"),
        ("{\xff}", "UTF-8"),
        ("[" * 100_000, "nested"),
        ({"frames": [{}]}, r"frames\[0\].file_path"),
        ({"frames": [frame(), 3]}, r"frames\[1\].file_path"),
        ({"frames": [{"file_path": "a"}]}, r"frames\[0\] \(a\).transform_matrix"),
        ({"frames": [frame(np.eye(3))]}, "4x4"),
        ({"frames": [frame(2 * np.eye(4))]}, "last row 0 0 0 1, found 0 0 0 2"),
        ({"frames": [frame(np.diag([1.0, 1, -1, 1]))]}, "not a rotation"),
        ({"frames": [frame(NAN)]}, r"frames\[0\] \(images/a.png\).transform_matrix.*found nan"),
        ({"frames": [frame()]}, "no focal length"),
        ({"fl_x": -1, "frames": [frame()]}, "fl_x is -1"),
        ({"fl_x": "wide", "frames": [frame()]}, "fl_x is 'wide'"),
        ({"camera_angle_x": 4, "frames": [frame()]}, "radians"),
        ({"fl_x": 1, "w": 0, "frames": [frame()]}, "0x100"),
        ({"fl_x": 1, "camera_model": "CYLINDRICAL", "frames": [frame()]}, "EQUIRECTANGULAR"),
        ({"w": 90, "camera_model": "EQUIRECTANGULAR", "frames": [frame()]}, "twice as wide"),
        ({"applied_transform": [[1]], "frames": [frame()]}, "applied_transform"),
        ({"fl_x": 10**400, "frames": [frame()]}, "fl_x"),
        ({"applied_scale": 10**400, "frames": [frame()]}, "applied_scale"),
        ({"applied_scale": 0, "frames": [frame()]}, "applied_scale"),
    ],
)
def test_messages_name_the_malformed_field(tmp_path, content, message):
    file = tmp_path / "transforms.json"
    if isinstance(content, dict):
        content = json.dumps(content)
    file.write_bytes(content.encode("latin-1"))
    with pytest.raises(UserError, match=message) as error:
        read_transforms(tmp_path, SIZES)
    assert error.value.file == file and error.value.fix


def test_no_file(tmp_path):
    with pytest.raises(UserError, match="found none"):
        read_frames(tmp_path)


def views(folder: Path, count: int, same: bool) -> list[View]:
    rng = np.random.default_rng(3)
    found = []
    for i in range(count):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = quat_to_rotation(rng.normal(size=4)), rng.normal(size=3)
        width = 200 if same else 200 + i
        image = str(folder / "data" / f"p{i}.png")
        mask = str(folder / "masks" / f"p{i}.png") if i == 1 else None
        view = View(image, image, mask, width, 100, 120.5, 119.25, 101.0, 49.5, pose, i == 0)
        found.append(view)
    return found


@pytest.mark.parametrize("same", [True, False])
def test_written_cameras_are_read_back_unchanged(tmp_path, same):
    written = views(tmp_path, 3, same)
    file = tmp_path / "results" / "export" / "transforms.json"
    write_transforms(file, written, file.parent, points="points.ply")
    names = [f"../../data/p{i}.png" for i in range(3)]
    model = read_transforms(
        file, {n: (v.width, v.height) for n, v in zip(names, written, strict=True)}
    )
    assert len(model.cameras) == (1 if same else 3)
    for name, view in zip(names, written, strict=True):
        image = model.by_name()[name]
        camera = model.cameras[image.camera_id]
        assert camera.model == "PINHOLE"
        assert (camera.width, camera.height) == (view.width, view.height)
        assert camera.pinhole == (view.fx, view.fy, view.cx, view.cy)
        np.testing.assert_allclose(image.world_to_camera, view.world_to_camera, atol=1e-12)
    frames = read_frames(file)
    assert [frame.mask for frame in frames] == [None, "../../masks/p1.png", None]


def test_written_axes_split_and_points_are_nerfstudios(tmp_path):
    (view,) = views(tmp_path, 1, True)
    file = tmp_path / "transforms.json"
    write_transforms(file, [view], tmp_path, points="points.ply")
    content = json.loads(file.read_text())
    matrix = np.array(content["frames"][0]["transform_matrix"])
    axes = view.world_to_camera[:3, :3]
    np.testing.assert_allclose(matrix[:3, 1], -axes[1], atol=1e-12)  # up is against y
    np.testing.assert_allclose(matrix[:3, 2], -axes[2], atol=1e-12)  # backward is against z
    np.testing.assert_allclose(matrix[:3, 3], view.centre, atol=1e-12)
    assert content["fl_x"] == 120.5 and content["w"] == 200
    assert content["train_filenames"] == [] and content["test_filenames"] == ["data/p0.png"]
    assert content["ply_file_path"] == "points.ply"


def test_relative_names_are_valid_if_a_folder_is_a_symbolic_link(tmp_path):
    (tmp_path / "disk" / "deep" / "export").mkdir(parents=True)
    (tmp_path / "results").symlink_to(tmp_path / "disk" / "deep")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "p0.png").touch()
    file = tmp_path / "results" / "export" / "transforms.json"
    write_transforms(file, views(tmp_path, 1, True), file.parent)
    assert (file.parent / read_frames(file)[0].name).is_file()
