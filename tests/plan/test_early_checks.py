"""Faults that headers show are errors of the plan, not of a stage hours later."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pipeline.config.schema import Config
from pipeline.io.depth_header import read_depth_header
from pipeline.photos.load import read_depth
from pipeline.runtime.errors import UserError
from tests.pictures import photos
from tests.plan.scans import look, many, plan_of, posed
from tests.plans import make_plan


def depth(folder: Path, name: str, write: Callable[[Path], Any]) -> Path:
    """A scene of which the second photograph has the depth map ``name``."""
    photos(folder / "images", 3)
    (folder / "depths").mkdir()
    write(folder / "depths" / name)
    return folder


def saved(shape: tuple[int, ...], dtype: Any = np.float32) -> Callable[[Path], Any]:
    values = np.zeros(shape, dtype)
    if dtype is object:
        return lambda path: np.save(path, values, allow_pickle=True)
    return lambda path: np.save(path, values)


def image(shape: tuple[int, ...], dtype: Any = np.uint16) -> Callable[[Path], Any]:
    return lambda path: cv2.imwrite(str(path), np.zeros(shape, dtype))


WRONG_DEPTHS = {
    "npy-size": ("p01.npy", saved((48, 48)), "48x48 pixels, another aspect ratio"),
    "npy-turned": ("p01.npy", saved((64, 48)), "width and height are swapped"),
    "npy-channels": ("p01.npy", saved((48, 64, 3)), "with 3 channels"),
    "npy-cube": ("p01.npy", saved((1, 48, 64, 2)), "one channel"),
    "npy-line": ("p01.npy", saved((64,)), "one channel"),
    "npy-complex": ("p01.npy", saved((48, 64), np.complex64), "values that are no numbers"),
    "npy-objects": ("p01.npy", saved((2, 3), object), "values that are no numbers"),
    "npz": ("p01.npz", lambda p: np.savez(p, d=np.zeros((9, 64))), "another aspect ratio"),
    "png-colours": ("p01.png", image((48, 64, 3)), "with 3 channels"),
    "png-size": ("p01.png", image((48, 48)), "another aspect ratio"),
    "tiff-size": ("p01.tif", image((30, 64), np.float32), "another aspect ratio"),
    "pfm": ("p01.pfm", lambda p: p.write_bytes(b"Pf\n48 48\n-1.0\n"), "another aspect ratio"),
    "pfm-colours": ("p01.pfm", lambda p: p.write_bytes(b"PF\n64 48\n-1.0\n"), "with 3 channels"),
    "exr": ("p01.exr", lambda p: p.write_bytes(b"v/1\x01"), "cannot be read: EXR"),
}


@pytest.mark.parametrize("case", WRONG_DEPTHS)
def test_a_depth_map_of_a_wrong_form_is_an_error_of_the_scan(tmp_path: Path, case: str) -> None:
    name, write, said = WRONG_DEPTHS[case]
    scene = depth(tmp_path / "s", name, write)
    with pytest.raises(UserError, match=said) as caught:
        look(scene)
    assert str(caught.value.file).endswith(name)


RIGHT_DEPTHS = {
    "npy": ("p01.npy", saved((48, 64))),
    "npy-channel": ("p01.npy", saved((48, 64, 1))),
    "npy-reduced": ("p01.npy", saved((12, 16), np.float64)),
    "npz": ("p01.npz", lambda path: np.savez(path, d=np.zeros((48, 64)))),
    "png": ("p01.png", image((48, 64))),
    "tiff": ("p01.tif", image((24, 32), np.float32)),
    "pfm": ("p01.pfm", lambda path: path.write_bytes(b"Pf\n64 48\n-1.0\n" + bytes(64 * 48 * 4))),
}


@pytest.mark.parametrize("case", RIGHT_DEPTHS)
def test_a_depth_map_of_the_right_form_is_accepted(tmp_path: Path, case: str) -> None:
    assert look(depth(tmp_path / "s", *RIGHT_DEPTHS[case])).num_depths == 1


@pytest.mark.parametrize("suffix", [".NPY", ".Npz", ".PNG", ".TIF"])
def test_suffixes_of_depth_maps_may_be_in_capitals(tmp_path: Path, suffix: str) -> None:
    name, write = RIGHT_DEPTHS[{".TIF": "tiff"}.get(suffix, suffix[1:].lower())]
    scene = depth(tmp_path / "s", name, write)
    file = (scene / "depths" / name).rename(scene / "depths" / f"p01{suffix}")
    assert look(scene).photos[1].depth == str(file)
    assert read_depth(file).ndim == 2
    assert read_depth_header(file) is not None


@pytest.mark.parametrize("size", [(8, 6), (10, 400), (400, 10), (1, 4000)])
def test_views_below_the_window_of_ssim_are_an_error_of_the_plan(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    photos(tmp_path / "s/images", 3, size)
    with pytest.raises(UserError, match="are too small for training: expected at least 11 pixels"):
        plan_of(tmp_path / "s")


def test_views_reduced_below_the_window_of_ssim_are_an_error_of_the_plan(tmp_path: Path) -> None:
    photos(tmp_path / "s/images", 3)
    plan_of(tmp_path / "s", views={"max_long_side_px": 16})
    with pytest.raises(UserError, match=r"raise views\.max_long_side_px"):
        plan_of(tmp_path / "s", views={"max_long_side_px": 12})


def test_single_views_below_the_window_of_ssim_are_named(tmp_path: Path) -> None:
    photos(tmp_path / "s/images", 3)
    cv2.imwrite(str(tmp_path / "s/images/strip.png"), np.zeros((4, 640, 3), np.uint8))
    said = "\n".join(plan_of(tmp_path / "s").stages["train"].decisions)
    assert "1 of 4 views have a shorter side of less than 11 pixels" in said
    assert "strip.png, 640x4 pixels" in said


def test_jobs_that_need_more_memory_than_is_configured_are_named(tmp_path: Path) -> None:
    scan = many(tmp_path / "s", 12, width=lambda i: 12_000, height=lambda i: 9000)

    def warned(**partition: Any) -> str:
        plan = make_plan(scan, Config.model_validate({"partition": partition}))
        return "\n".join(line for line in plan.warnings if "memory_mb" in line)

    assert warned() == warned(memory_mb=8000) == ""
    assert "partition.memory_mb: 700 MB may not be enough for" in warned(memory_mb=700)


def transforms(folder: Path, **fields: Any) -> Path:
    paths = photos(folder / "images", 4)
    frames = [
        {"file_path": f"images/{path.name}", "transform_matrix": np.eye(4).tolist()}
        for path in paths
    ]
    for number, frame in enumerate(frames):
        frame["transform_matrix"][0][3] = number
    content = {"w": 64, "h": 48, "fl_x": 60, "fl_y": 60} | fields
    content = {key: value for key, value in content.items() if value is not None}
    (folder / "transforms.json").write_text(json.dumps(content | {"frames": frames}))
    return folder


WRONG_CAMERAS = {
    "text": ({"w": "64"}, "w is '64'"),
    "focal-text": ({"fl_x": "60"}, "fl_x is '60'"),
    "swapped": ({"w": 48, "h": 64}, r"64x48, its given camera 48x64: .* are swapped"),
    "size": ({"w": 100, "h": 100}, "the aspect ratios differ"),
    "no-focal": ({"fl_x": None, "fl_y": None}, "no focal length"),
    "focal-in-mm": ({"fl_x": 0.035, "fl_y": 0.035}, "impossible focal length"),
    "focal-negative": ({"fl_x": -60}, "expected a positive number"),
    "centre": ({"cx": 1e6}, "impossible principal point"),
    "angle-in-degrees": ({"fl_x": None, "fl_y": None, "camera_angle_x": 60}, "camera_angle_x"),
    "distortion": ({"k1": -1e9}, "impossible lens distortion"),
    "no-size": ({"w": 0, "h": 0}, "impossible image size"),
}


@pytest.mark.parametrize("case", WRONG_CAMERAS)
def test_an_impossible_camera_is_an_error_of_the_scan(tmp_path: Path, case: str) -> None:
    fields, said = WRONG_CAMERAS[case]
    with pytest.raises(UserError, match=said):
        look(transforms(tmp_path / "s", **fields))
    look(transforms(tmp_path / "s", **fields), poses="ignore")


def test_possible_cameras_are_accepted(tmp_path: Path) -> None:
    for fields in ({}, {"w": 640, "h": 480, "fl_x": 600, "fl_y": 600}, {"w": None, "h": None}):
        assert look(transforms(tmp_path / "s", **fields)).poses is not None


def test_transposed_matrices_are_an_error_of_the_scan(tmp_path: Path) -> None:
    file = transforms(tmp_path) / "transforms.json"
    content = json.loads(file.read_text())
    for number, frame in enumerate(content["frames"]):
        matrix = np.eye(4)
        matrix[:3, 3] = number, 2, 3
        frame["transform_matrix"] = matrix.T.tolist()
    file.write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"transposed: its translation is in the last row"):
        look(tmp_path)


@pytest.mark.parametrize(
    ("size", "said"), [((48, 64), "are swapped"), ((64, 20), "aspect ratios differ")]
)
def test_cameras_of_a_model_are_compared_with_the_photographs(
    tmp_path: Path, size: tuple[int, int], said: str
) -> None:
    with pytest.raises(UserError, match=said):
        look(posed(tmp_path / "s", tracks=3, size=size))
