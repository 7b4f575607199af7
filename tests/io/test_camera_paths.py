"""Files of camera paths mean the cameras that the program that wrote them meant; others are
refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.io.camera_paths import read_camera_path
from pipeline.runtime.errors import UserError
from tests.io.camera_paths import FRAMES, NERFSTUDIO, path_file, world_to_camera

FILES = {"ours": path_file().model_dump(), "nerfstudio": NERFSTUDIO, "frames": FRAMES}


def read(folder, content):
    file = folder / "walk.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_camera_path(file)


@pytest.mark.parametrize("kind", FILES)
def test_all_programs_files_of_the_same_cameras_are_the_same_path(tmp_path, kind):
    path = read(tmp_path, FILES[kind])
    assert np.allclose(path.world_to_camera, world_to_camera(), atol=1e-12)
    assert np.allclose(path.focal, [1, 2])
    assert path.fps == 24
    assert path.size == (None if kind == "frames" else (64, 48))
    assert path.world == ("cameras" if kind == "nerfstudio" else "gaussians")


@given(
    quats=arrays(float, (3, 4), elements=st.floats(-1, 1)).filter(
        lambda q: (np.linalg.norm(q, axis=1) > 0.1).all()
    ),
    centres=arrays(float, (3, 3), elements=st.floats(-1e6, 1e6)),
)
def test_a_path_that_was_written_is_read_again(tmp_path_factory, quats, centres):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, :3] = quat_to_rotation(quats)
    poses[:, :3, 3] = centres
    folder = tmp_path_factory.mktemp("path")
    path_file(world_to_camera=poses.tolist(), focal_factors=None).write(folder)
    path = read_camera_path(folder / "path.json")
    assert np.allclose(path.world_to_camera[:, :3, :3], poses[:, :3, :3], atol=1e-9)
    assert np.allclose(path.world_to_camera[:, :3, 3], centres, rtol=1e-9, atol=1e-6)


def changed(kind, *keys, to):
    """A copy of a file with one value replaced."""
    content = json.loads(json.dumps(FILES[kind]))
    part = content
    for key in keys[:-1]:
        part = part[key]
    part[keys[-1]] = to
    return content


ZERO = [[0.0] * 4] * 4


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "expected JSON"),
        ("[" * 100_000, "expected JSON"),
        ([], "one of world_to_camera, camera_path, frames"),
        ({"poses": []}, "one of world_to_camera, camera_path, frames"),
        (changed("ours", "world_to_camera", to=[np.eye(4).tolist()]), "focal_factors"),
        (changed("frames", "frames", to=FRAMES["frames"][:1]), "at least two cameras"),
        (changed("nerfstudio", "camera_path", to=[]), "at least two cameras"),
        (changed("ours", "world_to_camera", 1, to=ZERO), "camera 1: expected the last row"),
        (changed("nerfstudio", "camera_path", 0, "camera_to_world", to=[1.0]), "camera 0"),
        (changed("nerfstudio", "camera_path", 0, "camera_to_world", 0, to=9.0), "not a rotation"),
        (changed("nerfstudio", "camera_path", 1, "fov", to=0), "camera_path.1.fov"),
        (changed("nerfstudio", "camera_type", to="fisheye"), "camera_type"),
        (changed("frames", "frames", 0, "target", to=[-1, -2, 3]), "frames.0: expected a target"),
        (changed("frames", "frames", 1, "up", to=[0, 1, 0]), "frames.1: expected a target"),
        (changed("frames", "frames", 1, "position", to=[1e300, 0, 0]), "frames.1.position"),
        ('{"frames": [{"position": [NaN, 0, 0], "target": [0, 0, 1]}]}', "frames.0.position"),
    ],
)
def test_what_is_no_path_is_refused_with_its_place(tmp_path, content, message):
    with pytest.raises(UserError, match=message) as caught:
        read(tmp_path, content)
    assert caught.value.file == tmp_path / "walk.json" and caught.value.fix


def test_a_file_that_does_not_exist_is_an_error_of_the_user(tmp_path):
    with pytest.raises(UserError, match="cannot be read"):
        read_camera_path(tmp_path / "walk.json")
