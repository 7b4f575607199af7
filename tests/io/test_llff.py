"""poses_bounds.npy: axes, sizes and messages."""

import numpy as np
import pytest

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.io.llff import read_poses_bounds
from pipeline.runtime.errors import UserError


def llff_row(rotation, centre, height, width, focal, near=1.0, far=9.0) -> np.ndarray:
    """A row from world to camera ``rotation`` with COLMAP's axes."""
    right, down, ahead = rotation
    matrix = np.stack([down, right, -ahead, centre, np.array([height, width, focal])], axis=1)
    return np.concatenate([matrix.ravel(), [near, far]])


def test_a_known_point_projects_to_its_pixel(tmp_path):
    rng = np.random.default_rng(0)
    rotation, centre = quat_to_rotation(rng.normal(size=4)), rng.normal(size=3)
    np.save(tmp_path / "p.npy", [llff_row(rotation, centre, 300, 400, 350.0, 2.0, 7.0)])
    model = read_poses_bounds(tmp_path / "p.npy", ["a.jpg"])
    image, camera = model.images[1], model.cameras[1]
    # A point 4 ahead, 0.5 to the right and 0.25 down.
    point = centre + rotation.T @ [0.5, 0.25, 4.0]
    local = image.rotation @ point + image.translation
    fx, fy, cx, cy = camera.pinhole
    found = [fx * local[0] / local[2] + cx, fy * local[1] / local[2] + cy]
    np.testing.assert_allclose(found, [200 + 350 * 0.5 / 4, 150 + 350 * 0.25 / 4])
    assert (camera.width, camera.height, image.name) == (400, 300, "a.jpg")


@pytest.mark.parametrize(
    "rows, message",
    [
        (np.zeros((1, 16)), "N x 17"),
        (np.zeros((2, 17)), "holds 2 poses, but there are 1"),
        (np.full((1, 17), np.nan), "row 0"),
        (np.ones((1, 17)), "not a rotation"),
        (llff_row(np.eye(3), np.zeros(3), 300, 400, -1)[None], "positive"),
        (np.array([["text"] * 17]), "not a NumPy array of numbers"),
    ],
)
def test_malformed(tmp_path, rows, message):
    np.save(tmp_path / "p.npy", rows)
    with pytest.raises(UserError, match=message) as error:
        read_poses_bounds(tmp_path / "p.npy", ["a.jpg"])
    assert error.value.file == tmp_path / "p.npy"


@pytest.mark.parametrize("data", [b"", b"no array", b"\x93NUMPY\x01\x00v\x00{"])
def test_not_an_array(tmp_path, data):
    (tmp_path / "p.npy").write_bytes(data)
    with pytest.raises(UserError):
        read_poses_bounds(tmp_path / "p.npy", ["a.jpg"])
