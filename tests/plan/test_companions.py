"""Masks and depth maps belong to photographs by many habits of naming."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.runtime.errors import UserError
from tests.io.test_transforms import frame, write
from tests.pictures import photos, picture
from tests.plan.test_scan import config, look, names


@pytest.mark.parametrize("folder", ["masks", "mask", "Masks", "images/masks"])
@pytest.mark.parametrize(
    "pattern",
    [
        "{}.png",
        "{}.JPG",
        "{}.jpg.png",
        "{}_mask.png",
        "{}.mask.png",
        "{}-mask.png",
        "mask_{}.png",
        "{}.jpg.mask.png",
        "{}_MASK.PNG",
        "dynamic_mask_{}.png",
    ],
)
def test_masks_by_every_habit_of_naming(tmp_path, folder, pattern):
    photos(tmp_path / "images", 2)
    for i in range(2):
        picture(tmp_path / folder / pattern.format(f"p0{i}"), mode="L")
    found = look(tmp_path)
    expected = [str(tmp_path / folder / pattern.format(f"p0{i}")) for i in range(2)]
    assert [photo.mask for photo in found.photos] == expected and not found.warnings


@pytest.mark.parametrize("folder", ["depths", "depth"])
@pytest.mark.parametrize(
    "pattern", ["{}.npy", "{}_depth.npy", "{}.depth.npy", "depth_{}.npy", "{}.jpg.npy"]
)
def test_depth_maps_by_every_habit_of_naming(tmp_path, folder, pattern):
    photos(tmp_path / "images", 2)
    (tmp_path / folder).mkdir()
    for i in range(2):
        np.save(tmp_path / folder / pattern.format(f"p0{i}"), np.ones((48, 64)))
    found = look(tmp_path)
    expected = [str(tmp_path / folder / pattern.format(f"p0{i}")) for i in range(2)]
    assert [photo.depth for photo in found.photos] == expected and not found.warnings


@pytest.mark.parametrize("pattern", ["{}_mask.png", "{}.jpg.mask.png", "dynamic_mask_{}.png"])
def test_masks_beside_photographs_are_no_photographs(tmp_path, pattern):
    photos(tmp_path / "images", 2)
    for i in range(2):
        picture(tmp_path / "images" / pattern.format(f"p0{i}"), mode="L")
    found = look(tmp_path)
    assert names(found) == ["p00.jpg", "p01.jpg"] and found.num_masks == 2
    assert "2 images beside the photographs are used as masks" in found.warnings[0]


def test_two_masks_beside_one_photograph_are_an_error_and_no_photographs(tmp_path):
    photos(tmp_path / "images", 2)
    for name in ("p00_mask.png", "p00-mask.png"):
        picture(tmp_path / "images" / name, mode="L")
    with pytest.raises(UserError, match=r"found 2 for p00\.jpg: p00-mask\.png, p00_mask\.png"):
        look(tmp_path)
    found = look(tmp_path, config(views={"masks": "ignore"}))
    assert names(found) == ["p00.jpg", "p01.jpg"] and found.num_masks == 0


def test_a_mask_beside_two_files_of_one_photograph_is_no_photograph(tmp_path):
    photos(tmp_path / "images", 1)
    picture(tmp_path / "images" / "p00.png")
    picture(tmp_path / "images" / "p00_mask.png", mode="L")
    found = look(tmp_path)
    assert names(found) == ["p00.jpg", "p00.png"] and found.num_masks == 2


def test_depth_maps_and_masks_that_transforms_list(tmp_path):
    photos(tmp_path / "images", 2)
    (tmp_path / "d").mkdir()
    frames = []
    for i in range(2):
        np.save(tmp_path / "d" / f"{i}.npy", np.ones((48, 64)))
        picture(tmp_path / "m" / f"{i}.png", mode="L")
        more = {"depth_file_path": f"d/{i}.npy", "mask_path": f"m/{i}.png"}
        frames.append(frame(path=f"images/p0{i}.jpg") | more)
    write(tmp_path, {"fl_x": 50, "frames": frames})
    found = look(tmp_path)
    assert [photo.depth for photo in found.photos] == [str(tmp_path / f"d/{i}.npy") for i in (0, 1)]
    assert found.num_masks == 2 and not found.warnings
    (tmp_path / "d" / "1.npy").unlink()
    assert "1 depth maps that transforms*.json lists are not used" in look(tmp_path).warnings[0]


@pytest.mark.parametrize(
    "files, named",
    [
        (["P00.png", "P00.PNG"], ["p00.jpg", "P00.png", "P00.PNG"]),
        (["p00_mask.png", "p00-mask.png"], ["p00_mask.png", "p00-mask.png"]),
    ],
)
def test_two_masks_of_one_photograph_are_an_error_that_names_both(tmp_path, files, named):
    photos(tmp_path / "images", 2)
    for name in files:
        picture(tmp_path / "masks" / name, mode="L")
    with pytest.raises(UserError, match="expected one mask for each photograph") as error:
        look(tmp_path)
    assert all(name in str(error.value) for name in named)
    assert look(tmp_path, config(views={"masks": "ignore"})).num_masks == 0


def test_a_mask_of_photographs_in_two_folders_is_an_error(tmp_path):
    photos(tmp_path / "images" / "left", 1)
    photos(tmp_path / "images" / "right", 1)
    picture(tmp_path / "masks" / "p00.png", mode="L")
    with pytest.raises(UserError, match=r"p00.png may belong to left/p00.jpg, right/p00.jpg"):
        look(tmp_path)


def test_photographs_and_masks_that_differ_in_case(tmp_path):
    for name in ("x.jpg", "X.jpg"):
        picture(tmp_path / "images" / name)
        picture(tmp_path / "masks" / name.replace("jpg", "png"), mode="L")
    found = look(tmp_path)
    assert [Path(photo.mask).stem for photo in found.photos] == ["X", "x"]
