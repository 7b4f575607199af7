"""Hostile pose files: numbers out of range, names that no file can have, paths out of the scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.config.schema import Config
from pipeline.plan.given_poses import GivenModel, load_given
from pipeline.plan.scan import Scan, scan
from pipeline.runtime.errors import UserError
from tests.io.test_transforms import frame
from tests.pictures import photos

Change = Callable[[dict[str, Any]], object]


def make_scene(folder: Path, change: Change = lambda content: None) -> Path:
    """Three photographs and their transforms.json, changed."""
    photos(folder / "images", 3)
    frames = [frame(path=f"images/p{i:02d}.jpg") for i in range(3)]
    for i, entry in enumerate(frames):
        entry["transform_matrix"][0][3] = float(i)
    content = {"fl_x": 50, "frames": frames}
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def look(folder: Path) -> tuple[Scan, GivenModel]:
    found = scan(folder, folder.name, Config(), cache=None)
    assert found.poses is not None
    path = folder / found.poses.path
    model = load_given(path, found.poses.kind, found.photos, found.listed, found.base_folder)
    return found, model


def move(value: float) -> Change:
    def change(content: dict[str, Any]) -> None:
        content["frames"][1]["transform_matrix"][0][3] = value

    return change


def rotate(value: float) -> Change:
    def change(content: dict[str, Any]) -> None:
        for row in content["frames"][1]["transform_matrix"][:3]:
            row[:3] = [value, -value, value]

    return change


def rename(name: object, key: str = "file_path") -> Change:
    return lambda content: content["frames"][1].update({key: name})


def put(**fields: object) -> Change:
    return lambda content: content.update(fields)


REFUSED: dict[str, tuple[Change, str]] = {
    "translation-1e308": (move(1e308), "p01.jpg.*expected values below .* found 1e.308"),
    "translation-1e20": (move(1e20), "p01.jpg.*expected values below"),
    "rotation-1e308": (rotate(1e308), "p01.jpg.*expected values below"),
    "rotation-1e155": (rotate(1e155), "p01.jpg.*expected values below"),
    "rotation-0": (rotate(0.0), "p01.jpg.*the matrix is not a rotation"),
    "lone-surrogate": (rename("images/\ud800.jpg"), r"frames\[1\].file_path: expected a file name"),
    "nul": (rename("images/\0.jpg"), r"frames\[1\].file_path: expected a file name"),
    "mask-surrogate": (rename("\ud800.png", "mask_path"), "mask_path: expected a file name"),
    "mask-number": (rename(3, "mask_path"), "mask_path: expected a file name, found 3"),
    "applied_scale-1e200": (put(applied_scale=1e200), "applied_scale.* found 1e.200"),
    "applied_scale-1e-200": (put(applied_scale=1e-200), "applied_scale.* found 1e-200"),
    "applied_transform-1e200": (
        put(applied_transform=(np.eye(4)[:3] * 1e200).tolist()),
        "applied_transform.* found 1e.200",
    ),
    "principal-point": (put(cx=1e299), "expected finite intrinsics"),
    "focal-length": (put(fl_x=1e299), "expected finite intrinsics"),
    "size": (put(w=1e18, h=1e18), "p00.jpg"),
    "size-digits": (put(w=10**4000), r"frames\[0\].*: w is .*expected a finite number"),
    **{
        f"distortion-{name}": (put(**{name: 1e299}), r"expected finite intrinsics .*1e\+299")
        for name in ("k1", "k2", "p1", "k3")
    },
    "fisheye": (
        put(camera_model="OPENCV_FISHEYE", k1=-1e299),
        "expected finite intrinsics",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_value_that_no_camera_has_is_named(tmp_path, case):
    change, expected = REFUSED[case]
    folder = make_scene(tmp_path / "scene", change)
    with pytest.raises(UserError, match=expected) as caught:
        look(folder)
    assert "transforms.json" in str(caught.value.file)
    assert "poses: ignore" in (caught.value.fix or "")
    assert len(str(caught.value)) < 600
    # The remedy holds.
    assert scan(folder, "scene", Config(poses="ignore"), cache=None).poses is None


def test_an_integer_of_5000_digits(tmp_path):
    folder = make_scene(tmp_path / "scene")
    file = folder / "transforms.json"
    file.write_text(file.read_text().replace('"fl_x": 50', f'"fl_x": {"9" * 5000}'))
    with pytest.raises(UserError, match=r"fl_x is .inf., expected a finite number"):
        look(folder)


def test_a_pose_file_that_never_ends(tmp_path):
    photos(tmp_path / "images", 2)
    (tmp_path / "transforms.json").symlink_to("/dev/zero")
    assert scan(tmp_path, "scene", Config(), cache=None).poses is None


def repeat(content: dict[str, Any]) -> None:
    content["frames"].append(content["frames"][0] | {"transform_matrix": np.eye(4).tolist()})
    content["frames"][-1]["transform_matrix"][0][3] = 9.0


def test_a_photograph_with_two_poses_is_an_error(tmp_path):
    with pytest.raises(UserError, match=r"p00\.jpg.*the same photograph with different poses"):
        look(make_scene(tmp_path / "scene", repeat))


def test_a_repeated_frame_of_the_same_pose_is_used_once(tmp_path):
    def again(content: dict[str, Any]) -> None:
        content["frames"].append(dict(content["frames"][0]))

    found, given = look(make_scene(tmp_path / "scene", again))
    assert not found.warnings and given.model.by_name()["p00.jpg"].centre[0] == 0


def test_splits_that_list_the_same_frames_are_no_split(tmp_path):
    folder = make_scene(tmp_path / "scene")
    (folder / "transforms_train.json").write_bytes((folder / "transforms.json").read_bytes())
    (folder / "transforms.json").rename(folder / "transforms_val.json")
    (said,) = look(folder)[0].warnings
    assert "split is not used, because it lists no test view beside the training views" in said


@pytest.mark.parametrize("where", ["../other/p00.jpg", "{root}/other/p00.jpg", "gone.png"])
def test_a_mask_outside_of_the_scene_is_not_read(tmp_path, where):
    photos(tmp_path / "other", 1, mode="L")
    mask = where.format(root=tmp_path)
    found, _ = look(make_scene(tmp_path / "scene", rename(mask, "mask_path")))
    assert found.num_masks == 0
    assert "1 masks that transforms*.json lists are not used" in found.warnings[0]
    assert found.warnings[0].endswith(f"(first: {mask})")


@pytest.mark.parametrize("where", ["../other/p00.jpg", "{root}/other/p00.jpg"])
def test_a_photograph_outside_of_the_scene_is_not_read(tmp_path, where):
    photos(tmp_path / "other", 1)
    found, given = look(make_scene(tmp_path / "scene", rename(where.format(root=tmp_path))))
    assert [photo.name for photo in found.photos] == ["p00.jpg", "p02.jpg"]
    assert len(given.model.images) == 2
    assert any("1 of 3 poses have no photograph" in line for line in found.warnings)
