"""COLMAP models: round trips, exchange with pycolmap, and errors on damaged files."""

import json
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.geometry.cameras import CAMERA_MODELS, Camera
from pipeline.geometry.rotations import quat_to_rotation, rotation_to_quat
from pipeline.io.colmap import read_model, write_model
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction

FILES = ("cameras", "images", "points3D")
FORMATS = pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
BOUNDED = settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def make_model(
    seed: int, num_images: int = 4, num_points: int = 9, names: list[str] | None = None
) -> Reconstruction:
    """A model whose observations are the exact projections of its points."""
    rng = np.random.default_rng(seed)
    cameras = {
        7: Camera("PINHOLE", 640, 480, np.array([500.0, 510.0, 321.5, 239.25])),
        3: Camera("SIMPLE_PINHOLE", 320, 200, np.array([250.0, 160.0, 100.0])),
    }
    names = names or [f"sub/photo {i}.jpg" for i in range(num_images)]
    images = {}
    for i, name in enumerate(names):
        turn = quat_to_rotation(np.array([1.0, *(0.2 * rng.normal(size=3))]))
        images[11 + 5 * i] = PosedImage(
            name, (7, 3)[i % 2], turn, np.array([0, 0, 6.0]) + rng.random(3)
        )
    xyz = rng.normal(size=(num_points, 3))
    start, ids, pixels = [0], [], []
    for point in xyz:
        seen = [i for i in images if rng.random() < 0.7] or [next(iter(images))] * bool(images)
        for i in seen:
            local = images[i].rotation @ point + images[i].translation
            fx, fy, cx, cy = cameras[images[i].camera_id].pinhole
            ids.append(i)
            pixels.append((fx * local[0] / local[2] + cx, fy * local[1] / local[2] + cy))
        start.append(len(ids))
    points = Points(
        xyz,
        rng.integers(0, 256, (num_points, 3)).astype(np.uint8),
        rng.random(num_points),
        np.array(start, np.int64),
        np.array(ids, np.int64),
        np.array(pixels, np.float64).reshape(-1, 2),
    )
    return Reconstruction(cameras, images, points)


def assert_same(a: Reconstruction, b: Reconstruction) -> None:
    assert a.cameras.keys() == b.cameras.keys()
    for number, camera in a.cameras.items():
        other = b.cameras[number]
        assert (camera.model, camera.width, camera.height) == (
            other.model,
            other.width,
            other.height,
        )
        np.testing.assert_array_equal(camera.params, other.params)
    assert a.images.keys() == b.images.keys()
    for number, image in a.images.items():
        other = b.images[number]
        assert (image.name, image.camera_id) == (other.name, other.camera_id)
        np.testing.assert_allclose(image.rotation, other.rotation, atol=1e-14)
        np.testing.assert_array_equal(image.translation, other.translation)
    for field in fields(Points):
        mine, its = getattr(a.points, field.name), getattr(b.points, field.name)
        assert mine.dtype == its.dtype, field.name
        np.testing.assert_array_equal(mine, its, err_msg=field.name)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


names_of_files = st.text(
    st.characters(exclude_categories=("C", "Z")) | st.sampled_from("/ "), min_size=1, max_size=12
).map(lambda s: f"a{s}b")


@FORMATS
@BOUNDED
@given(
    seed=st.integers(0, 10**6),
    names=st.lists(names_of_files, max_size=5, unique=True),
    num_points=st.integers(0, 8),
)
def test_round_trip(tmp_path, text, seed, names, num_points):
    model = make_model(seed, num_points=num_points if names else 0, names=names or None)
    write_model(tmp_path, model, text=text)
    assert_same(read_model(tmp_path), model)


@BOUNDED
@given(st.sampled_from(sorted(CAMERA_MODELS)), st.integers(0, 10**6))
def test_every_camera_model_in_both_formats(tmp_path, name, seed):
    count = len(CAMERA_MODELS[name][1])
    params = np.random.default_rng(seed).random(count) + 0.1
    if name == "EQUIRECTANGULAR":
        params = np.array([64.0, 48.0])
    model = Reconstruction({1: Camera(name, 64, 48, params)}, {})
    for text in (False, True):
        write_model(tmp_path, model, text=text)
        assert_same(read_model(tmp_path), model)


def test_a_panorama_whose_parameters_are_not_its_size_is_an_error(tmp_path):
    camera = Camera("EQUIRECTANGULAR", 64, 32, np.array([128.0, 64.0]))
    write_model(tmp_path, Reconstruction({1: camera}, {}))
    with pytest.raises(UserError, match="64x32"):
        read_model(tmp_path)


def test_empty_model(tmp_path):
    for text in (False, True):
        write_model(tmp_path, Reconstruction({}, {}), text=text)
        model = read_model(tmp_path)
        assert (model.cameras, model.images, len(model.points)) == ({}, {}, 0)


def test_same_model_same_bytes_and_files_of_other_models_are_removed(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    b.mkdir()
    for stale in ("cameras.txt", "images.txt", "points3D.txt", "rigs.bin", "frames.bin"):
        (b / stale).write_text("another model's")
    write_model(a, make_model(1))
    write_model(b, make_model(1))
    assert contents(a) == contents(b)


def test_points_are_sorted_by_id(tmp_path):
    write_model(tmp_path, make_model(2), text=True)
    before = read_model(tmp_path)
    file = tmp_path / "points3D.txt"
    header, *rows = file.read_text().splitlines()
    file.write_text("\n".join([header, *reversed(rows)]) + "\n")
    assert_same(read_model(tmp_path), before)


def test_unknown_observations_are_left_out(tmp_path):
    model = make_model(3)
    model.points.track_xy[0] = np.nan
    write_model(tmp_path, model)
    points = read_model(tmp_path).points
    assert points.track_length[0] == model.points.track_length[0] - 1
    assert np.isfinite(points.track_xy).all()


def test_points_without_keypoints_in_images_have_unknown_pixels(tmp_path):
    """Tracks of models without keypoints still give the images that see a point."""
    write_model(tmp_path, make_model(4), text=True)
    before = read_model(tmp_path).points
    file = tmp_path / "images.txt"
    lines = [line for line in file.read_text().splitlines() if not line.startswith("#")]
    file.write_text("".join(f"{line}\n\n" for line in lines[::2]))
    points = read_model(tmp_path).points
    np.testing.assert_array_equal(points.track_image_id, before.track_image_id)
    assert np.isnan(points.track_xy).all()


@FORMATS
def test_pycolmap_reads_ours_and_we_read_pycolmaps(tmp_path, text):
    # COLMAP's text reader ends names at the first space.
    names = [f"sub/photo{'_' if text else ' '}{i}.jpg" for i in range(4)]
    model = make_model(5, names=names)
    write_model(tmp_path / "ours", model, text=text)
    program = """
import json, sys, pycolmap
folder = sys.argv[1]
model = pycolmap.Reconstruction(folder + "/ours")
model.write_text(folder + "/theirs") if sys.argv[2] == "True" else model.write(folder + "/theirs")
model.update_point_3d_errors()
print(json.dumps({
    "images": {i: im.name for i, im in model.images.items()},
    "centres": {i: im.projection_center().tolist() for i, im in model.images.items()},
    "points": len(model.points3D),
    "observations": model.compute_num_observations(),
    "error": max(p.error for p in model.points3D.values()),
}))
"""
    (tmp_path / "theirs").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path), str(text)],
        capture_output=True,
        text=True,
        check=True,
    )
    seen = json.loads(done.stdout.splitlines()[-1])
    assert seen["images"] == {str(i): image.name for i, image in model.images.items()}
    for i, image in model.images.items():
        np.testing.assert_allclose(seen["centres"][str(i)], image.centre, atol=1e-12)
    assert seen["points"] == len(model.points)
    assert seen["observations"] == len(model.points.track_image_id)
    # The reprojection error pycolmap finds: tracks, pixels, poses and intrinsics all agree.
    assert seen["error"] < 1e-9
    assert_same(read_model(tmp_path / "theirs"), read_model(tmp_path / "ours"))


@pytest.mark.parametrize("stem", FILES)
def test_truncated_binary_files_are_user_errors(tmp_path, stem):
    write_model(tmp_path, make_model(6, num_images=2, num_points=2))
    file = tmp_path / f"{stem}.bin"
    whole = file.read_bytes()
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        with pytest.raises(UserError) as error:
            read_model(tmp_path)
        assert error.value.file == file and error.value.fix, length
    file.write_bytes(whole + b"\0")
    with pytest.raises(UserError):
        read_model(tmp_path)


@pytest.mark.parametrize("stem", FILES)
def test_truncated_text_files_are_read_or_user_errors(tmp_path, stem):
    """A text file that is truncated within a number or after a line can still be valid."""
    write_model(tmp_path, make_model(6, num_images=2, num_points=2), text=True)
    file = tmp_path / f"{stem}.txt"
    whole = file.read_bytes()
    refused = 0
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        try:
            read_model(tmp_path)
        except UserError as error:
            assert error.fix
            refused += 1
    assert refused > 0


@FORMATS
@BOUNDED
@given(
    stem=st.sampled_from(FILES),
    where=st.floats(0, 1, exclude_max=True),
    data=st.binary(min_size=1, max_size=9),
)
def test_damaged_files_are_read_or_user_errors(tmp_path, text, stem, where, data):
    write_model(tmp_path, make_model(7, num_images=2, num_points=3), text=text)
    file = tmp_path / f"{stem}.{'txt' if text else 'bin'}"
    whole = file.read_bytes()
    at = int(where * len(whole))
    file.write_bytes(whole[:at] + data + whole[at + len(data) :])
    try:
        read_model(tmp_path)
    except UserError as error:
        assert error.fix


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


def test_messages_name_the_fault(tmp_path):
    def broken(stem: str, old: str, new: str) -> str:
        write_model(tmp_path, make_model(8), text=True)
        edit(tmp_path / f"{stem}.txt", old, new)
        with pytest.raises(UserError) as error:
            read_model(tmp_path)
        assert str(tmp_path / f"{stem}.txt") in str(error.value)
        return str(error.value)

    assert "THIN_PRISM_FISHEYE" in broken("cameras", " PINHOLE", " THIN_PRISM_FISHEYE")
    assert "found 3" in broken("cameras", " 239.25", "")
    assert "positive focal" in broken("cameras", " 500.0", " -500.0")
    assert "0x480" in broken("cameras", "640", "0")
    write_model(tmp_path, make_model(8), text=True)
    line = (tmp_path / "images.txt").read_text().splitlines()[2]
    nan = " ".join(["11", "nan", *line.split()[2:]])
    assert "sub/photo 0.jpg" in broken("images", line, nan)
    assert "finite pose" in broken("images", line, "11 0 0 0 0 0 0 6 7 sub/photo 0.jpg")
    assert "camera 99" in broken("images", line, line.replace(" 7 sub", " 99 sub"))
    assert "line 3" in broken("images", line, "11 1 0 0")
    assert "image id 4000" in broken("points3D", " 11 ", " 4000 ")
    assert "line 2" in broken("points3D", "1 ", "one ")


def test_no_model(tmp_path):
    (tmp_path / "cameras.bin").write_bytes(b"")
    with pytest.raises(UserError, match="found none"):
        read_model(tmp_path)


def test_names_the_format_cannot_hold(tmp_path):
    with pytest.raises(ValueError):
        write_model(tmp_path, make_model(9, names=["two\nlines"]))


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.dot(q, q) > 1e-4))
def test_quaternions_and_rotations(values):
    quat = np.array(values) / np.linalg.norm(values)
    rotation = quat_to_rotation(3 * quat)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) > 0
    back = rotation_to_quat(rotation)
    assert back[0] >= 0 and abs(abs(back @ quat) - 1) < 1e-14


def test_half_turns_and_handedness():
    for axis in range(3):
        quat = np.zeros(4)
        quat[axis + 1] = 1.0
        rotation = quat_to_rotation(quat)
        np.testing.assert_allclose(np.abs(rotation_to_quat(rotation)), quat, atol=1e-15)
    quarter = quat_to_rotation(np.array([1.0, 0.0, 0.0, 1.0]))
    np.testing.assert_allclose(quarter @ [1.0, 0, 0], [0, 1.0, 0], atol=1e-15)


def test_a_model_of_colmap_with_rigs_and_every_camera_model_is_read(tmp_path):
    """Written by pycolmap, in a process of its own."""
    script = """
import sys, numpy as np, pycolmap
model = pycolmap.Reconstruction()
rng = np.random.default_rng(3)
kinds = [k for n, k in pycolmap.CameraModelId.__members__.items()
         if n != "INVALID"]
for i, kind in enumerate(kinds, 1):
    camera = pycolmap.Camera.create_from_model_id(i, kind, 500.0, 640, 480)
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name=f"{kind.name}.jpg", camera_id=i, image_id=i)
    q = rng.normal(size=4)
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(q / np.linalg.norm(q)), rng.normal(size=3))
    model.add_image_with_trivial_frame(image, pose)
model.write(sys.argv[1])
for image in model.images.values():
    print(image.name, *image.cam_from_world().matrix().ravel().tolist())
"""
    process = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True, check=True
    )
    assert (tmp_path / "rigs.bin").is_file() and (tmp_path / "frames.bin").is_file()
    model = read_model(tmp_path)
    lines = process.stdout.split("\n")[:-1]
    assert len(lines) == len(model.images) == len(CAMERA_MODELS)
    for line in lines:
        name, *values = line.split()
        image = model.by_name()[name]
        expected = np.array([float(value) for value in values]).reshape(3, 4)
        np.testing.assert_allclose(image.world_to_camera[:3], expected, atol=1e-12)
        assert model.cameras[image.camera_id].model == name.removesuffix(".jpg")
