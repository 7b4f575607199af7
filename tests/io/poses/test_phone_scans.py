"""Polycam, Record3D and ScanNet folders: axes, intrinsics, lost frames, hostile files."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pipeline.geometry.rotations import rotation_to_quat
from pipeline.io.poses import polycam, record3d
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import PosedImage, Reconstruction
from tests.io.poses.known import (
    FLIP_YZ,
    HEIGHT,
    WIDTH,
    check_same,
    known_scene,
    opencv,
    read,
)
from tests.pictures import picture
from tests.plan.test_scan import given_model, look, names

FX, FY, CX, CY = opencv().params.tolist()


def opengl(image: PosedImage) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = image.rotation.T @ FLIP_YZ, image.centre
    return pose


def polycam_json(image: PosedImage) -> str:
    pose = opengl(image)
    content = {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "width": WIDTH, "height": HEIGHT}
    content |= {f"t_{i}{j}": pose[i, j] for i in range(3) for j in range(4)}
    return json.dumps(content | {"blur_score": 80.1, "timestamp": 125_318_290_861})


def write_polycam(folder, model: Reconstruction, kind: str = "corrected_") -> None:
    for image in model.images.values():
        stem = image.name.split("/")[-1]
        file = folder / "keyframes" / f"{kind}cameras" / f"{stem}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(polycam_json(image))
        (folder / "keyframes" / f"{kind}images").mkdir(exist_ok=True)


def record3d_json(model: Reconstruction, **more) -> str:
    poses = []
    for image in model.images.values():
        w, x, y, z = rotation_to_quat(image.rotation.T @ FLIP_YZ).tolist()
        poses.append([x, y, z, w, *image.centre.tolist()])
    k = [FX, 0, 0, 0, FY, 0, CX, CY, 1]
    return json.dumps({"h": HEIGHT, "w": WIDTH, "fps": 60, "K": k, "poses": poses, **more})


def write_record3d(folder, content: str | bytes):
    (folder / "rgb").mkdir(exist_ok=True)
    file = folder / "metadata"
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    return file


def write_scannet(folder, model: Reconstruction) -> None:
    for name in ("pose", "color", "intrinsic"):
        (folder / name).mkdir(exist_ok=True)
    matrix = np.eye(4)
    matrix[0, 0], matrix[1, 1], matrix[:2, 2] = FX, FY, (CX, CY)
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", matrix)
    for image in model.images.values():
        pose = opengl(image)
        pose[:3, :3] = pose[:3, :3] @ FLIP_YZ
        np.savetxt(folder / "pose" / f"{image.name.split('/')[-1]}.txt", pose)


@pytest.mark.parametrize("kind", ["corrected_", ""])
def test_polycam(tmp_path, kind):
    known = known_scene(opencv(), names=f"keyframes/{kind}images/{{}}")
    write_polycam(tmp_path, known, kind)
    check_same(read("polycam", tmp_path), known)


def test_corrected_polycam_poses_are_preferred(tmp_path):
    write_polycam(tmp_path, known_scene(opencv(), names="{}"), "")
    write_polycam(tmp_path, known_scene(opencv(), names="{}"))
    assert polycam.find(tmp_path) == "keyframes/corrected_cameras"


def test_record3d(tmp_path):
    known = known_scene(opencv(), names="rgb/{}")
    file = write_record3d(tmp_path, record3d_json(known))
    check_same(read("record3d", tmp_path), known)
    each = [[600 + i, 600, CX, CY] for i in range(4)]
    file.write_text(record3d_json(known, perFrameIntrinsicCoeffs=each))
    found = read("record3d", tmp_path)
    focal = [found.cameras[image.camera_id].pinhole[0] for image in found.images.values()]
    assert focal == [600, 601, 602, 603]


def test_scannet(tmp_path):
    known = known_scene(opencv(), names="color/{}")
    write_scannet(tmp_path, known)
    check_same(read("scannet", tmp_path), known)


def test_lost_frames_of_scannet_are_left_out_with_a_message(tmp_path):
    for i in range(4):
        picture(tmp_path / "color" / f"{i}.jpg", size=(WIDTH, HEIGHT))
    write_scannet(tmp_path, known_scene(opencv(), names="color/{}"))
    np.savetxt(tmp_path / "pose" / "2.txt", np.full((4, 4), -np.inf))
    found = look(tmp_path)
    assert (found.poses.kind, found.image_folder, len(names(found))) == ("scannet", "color", 3)
    assert any("1 photographs are not used" in line for line in found.warnings)
    assert sorted(given_model(found).model.by_name()) == ["0.jpg", "1.jpg", "3.jpg"]


def test_photographs_of_polycam_are_the_corrected_ones(tmp_path):
    for kind in ("images", "corrected_images"):
        picture(tmp_path / "keyframes" / kind / "0.jpg", size=(WIDTH, HEIGHT))
        picture(tmp_path / "keyframes" / kind / "1.jpg", size=(WIDTH, HEIGHT))
    write_polycam(tmp_path, known_scene(opencv(), 2, names="{}"))
    assert look(tmp_path).image_folder == "keyframes/corrected_images"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "'poses'"),
        (record3d_json(known_scene(opencv()), K=[1]), "K: expected 9 numbers"),
        (record3d_json(known_scene(opencv()), w=-5), "image size"),
        (record3d_json(known_scene(opencv()), poses=[[0] * 7]), "unit quaternion"),
        (record3d_json(known_scene(opencv()), poses=[[0, 0, 0, 1, 1e20, 0, 0]]), "position"),
        ('{"poses": [' + "9" * 5000 + "]}", "finite|numbers"),
    ],
)
def test_messages(tmp_path, content, message):
    file = write_record3d(tmp_path, content)
    with pytest.raises(UserError, match=message) as error:
        record3d.frames(file)
    assert error.value.file == file
