"""Pose matrices that are transposed, mirrored, scaled or in degrees end with an error that says so,
in every format that has them; ways of writing right ones give the same pose."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.io.llff import read_poses_bounds
from pipeline.io.poses import metashape, opensfm, polycam, scannet
from pipeline.io.poses.matrices import pose_matrix
from pipeline.io.transforms import read_frames
from pipeline.runtime.errors import UserError
from tests.io.poses import test_metashape, test_photogrammetry
from tests.io.poses.known import HEIGHT, WIDTH, known_scene, opencv

Matrix = np.ndarray
MIRROR = np.diag([-1.0, 1, 1, 1])


def camera_to_world() -> Matrix:
    matrix = np.eye(4)
    matrix[:3, :3] = quat_to_rotation(np.array([0.8, 0.3, -0.4, 0.2]))
    matrix[:3, 3] = 1.5, -2.0, 0.25
    return matrix


def of_transforms(folder: Path, matrix: Matrix) -> object:
    frame = {"file_path": "a.png", "transform_matrix": matrix.tolist(), "fl_x": 100}
    (folder / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    return read_frames(folder / "transforms.json")


def of_metashape(folder: Path, matrix: Matrix) -> object:
    lens = opencv()
    text = test_metashape.export(known_scene(lens), test_metashape.calibration(lens))
    numbers = " ".join(f"{value:.12g}" for value in matrix.ravel())
    pattern = re.compile(r"(<camera [^>]*>\s*<transform>)[^<]*(</transform>)", re.DOTALL)
    assert pattern.search(text), text[:500]
    (folder / "cameras.xml").write_text(pattern.sub(rf"\g<1>{numbers}\g<2>", text))
    return metashape.frames(folder / "cameras.xml")


def of_scannet(folder: Path, matrix: Matrix) -> object:
    for name in ("pose", "color", "intrinsic"):
        (folder / name).mkdir()
    np.savetxt(folder / "pose" / "0.txt", matrix)
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", np.eye(4))
    return scannet.frames(folder)


def of_polycam(folder: Path, matrix: Matrix) -> object:
    values = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
    values |= {"fx": 100, "fy": 100, "cx": 50, "cy": 40, "width": 100, "height": 80}
    cameras = folder / "keyframes" / "cameras"
    cameras.mkdir(parents=True)
    (cameras / "1.json").write_text(json.dumps(values))
    return polycam.frames(cameras)


def of_llff(folder: Path, matrix: Matrix) -> object:
    # The columns are down, right, backward.
    table = np.column_stack([-matrix[:3, 1], matrix[:3, 0], matrix[:3, 2:4], (80, 100, 90)])
    np.save(folder / "poses_bounds.npy", np.append(table.ravel(), (1.0, 9.0))[None])
    return read_poses_bounds(folder / "poses_bounds.npy", ["a.png"])


WITH_LAST_ROW = [of_transforms, of_metashape, of_scannet]
Reader = Callable[[Path, Matrix], object]


@pytest.mark.parametrize("read", [*WITH_LAST_ROW, of_polycam, of_llff])
def test_a_right_matrix_is_read(read: Reader, tmp_path: Path) -> None:
    assert read(tmp_path, camera_to_world())


@pytest.mark.parametrize("read", WITH_LAST_ROW)
def test_a_translation_in_the_last_row_is_named(read: Reader, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"transposed: its translation is in the last row") as error:
        read(tmp_path, camera_to_world().T)
    assert error.value.file and "transpose the matrices" in str(error.value.fix)


@pytest.mark.parametrize("read", WITH_LAST_ROW)
def test_another_last_row_is_an_error(read: Reader, tmp_path: Path) -> None:
    matrix = camera_to_world()
    matrix[3] = 0, 0, 1, 1
    with pytest.raises(UserError, match="expected the last row 0 0 0 1, found 0 0 1 1"):
        read(tmp_path, matrix)


@pytest.mark.parametrize("read", [*WITH_LAST_ROW, of_polycam, of_llff])
def test_a_mirrored_matrix_is_named(read: Reader, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="mirrored"):
        read(tmp_path, camera_to_world() @ MIRROR)


@pytest.mark.parametrize("read", [of_transforms, of_metashape, of_scannet])
def test_scaled_axes_are_named(read: Reader, tmp_path: Path) -> None:
    matrix = camera_to_world()
    matrix[:3, :3] *= 1.5
    with pytest.raises(UserError, match=r"its axes have the lengths 1\.5, 1\.5, 1\.5"):
        read(tmp_path, matrix)


FORMS: dict[str, Callable[[Matrix], object]] = {
    "4x4": lambda matrix: matrix.tolist(),
    "3x4": lambda matrix: matrix[:3].tolist(),
    "16 numbers": lambda matrix: matrix.ravel().tolist(),
    "12 numbers": lambda matrix: matrix[:3].ravel().tolist(),
    "text": lambda matrix: [[str(value) for value in row] for row in matrix.tolist()],
}


@given(
    form=st.sampled_from(sorted(FORMS)),
    quat=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1),
    centre=st.tuples(*[st.floats(-1e6, 1e6)] * 3),
)
def test_forms_of_one_matrix_are_equal_and_its_transpose_is_an_error(form, quat, centre) -> None:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = quat_to_rotation(np.array(quat)), centre
    file = Path("transforms.json")
    np.testing.assert_array_equal(pose_matrix(file, "m", FORMS[form](matrix)), matrix)
    if np.abs(matrix[:3, 3]).max() > 0.01 and form in ("4x4", "16 numbers", "text"):
        with pytest.raises(UserError, match="transposed"):
            pose_matrix(file, "m", FORMS[form](matrix.T))


def test_degrees_for_a_field_of_view_are_named(tmp_path: Path) -> None:
    from pipeline.io.transforms import read_transforms

    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    content = {"camera_angle_x": 50.0, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="degrees") as error:
        read_transforms(tmp_path / "transforms.json", {"a.png": (100, 80)})
    assert "0.872665" in str(error.value.fix)


def test_degrees_for_a_rotation_vector_are_named(tmp_path: Path) -> None:
    camera = {"projection_type": "perspective", "width": WIDTH, "height": HEIGHT, "focal": 0.9}
    text = test_photogrammetry.opensfm_json(known_scene(opencv()), camera)
    content = json.loads(text)
    for shot in (shot for part in content for shot in part["shots"].values()):
        shot["rotation"] = [0.0, 35.0, -20.0]
    (tmp_path / "reconstruction.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="degrees"):
        opensfm.frames(tmp_path / "reconstruction.json")
