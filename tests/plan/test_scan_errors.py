"""Scans of scene folders with missing, damaged or contradictory files."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from pipeline.runtime.errors import UserError
from tests.io.test_llff import llff_row
from tests.io.test_transforms import frame, write
from tests.pictures import photos, picture
from tests.plan.test_scan import config, given_model, look, names, write_sparse


def test_the_error_for_a_missing_scene_lists_the_scenes(tmp_path):
    photos(tmp_path / "house", 1)
    with pytest.raises(UserError, match="no such scene") as error:
        look(tmp_path / "hose")
    assert "house" in error.value.fix
    with pytest.raises(UserError, match="folder of scenes does not exist"):
        look(tmp_path / "nowhere" / "house")


def test_empty_folder_and_too_few(tmp_path):
    with pytest.raises(UserError, match="no photograph"):
        look(tmp_path)
    (tmp_path / "images").mkdir()
    with pytest.raises(UserError, match="no photograph"):
        look(tmp_path)
    photos(tmp_path / "images", 1)
    with pytest.raises(UserError, match="only 1 readable"):
        look(tmp_path)
    assert len(look(tmp_path, config(inspect={"min_images": 1})).photos) == 1


def test_unreadable_files_are_warnings(tmp_path):
    photos(tmp_path / "images", 2)
    (tmp_path / "images" / "text.jpg").write_text("not a picture")
    (tmp_path / "images" / "empty.png").write_bytes(b"")
    (tmp_path / "images" / "gone.jpg").symlink_to(tmp_path / "nowhere.jpg")
    (tmp_path / "images" / "phone.HEIC").write_bytes(b"")
    result = look(tmp_path)
    assert names(result) == ["p00.jpg", "p01.jpg"]
    for name in ("text.jpg", "empty.png", "gone.jpg", "phone.HEIC"):
        assert sum(name in line for line in result.warnings) == 1, name
    assert any(line.startswith("text.jpg: left out: ") for line in result.warnings)


def test_files_that_are_no_photographs_by_name_are_named_from_the_scene_folder(tmp_path):
    photos(tmp_path / "images", 2)
    (tmp_path / "images" / "b").mkdir()
    (tmp_path / "images" / "b" / "big.jxl").write_bytes(b"")
    Path(os.fsdecode(os.fsencode(tmp_path / "images" / "b") + b"/\xff.jpg")).write_bytes(b"")
    not_utf8, unread = look(tmp_path).warnings
    assert not_utf8.startswith("images/b/\ufffd.jpg is not used: its name is not UTF-8")
    assert unread.startswith("1 JXL images are not used (first: images/b/big.jxl)")


def test_mask_of_another_size(tmp_path):
    photos(tmp_path / "images", 2)
    picture(tmp_path / "masks" / "p01.png", (48, 64), mode="L")
    with pytest.raises(UserError, match=r"48x64.*p01.jpg is 64x48"):
        look(tmp_path)


def test_poses_of_other_photographs(tmp_path):
    photos(tmp_path / "images", 2)
    write_sparse(tmp_path / "sparse" / "0", ["x.jpg", "y.jpg"], (64, 48))
    with pytest.raises(UserError, match="none of its 2 images is a photograph"):
        look(tmp_path)
    write_sparse(tmp_path / "sparse" / "0", ["p00.jpg"], (48, 64))
    with pytest.raises(UserError, match="64x48, its given camera 48x64"):
        given_model(look(tmp_path))


def test_poses_of_rotated_photographs_are_a_user_error(tmp_path):
    """Poses must refer to the stored pixels, not to images rotated by EXIF orientation."""
    photos(tmp_path / "a" / "images", 2)
    frames = [frame(path=f"images/p0{i}.jpg") for i in range(2)]
    write(tmp_path / "a", {"fl_x": 50, "w": 48, "h": 64, "frames": frames})
    photos(tmp_path / "b" / "images", 2)
    rows = [llff_row(np.eye(3), np.zeros(3), 64, 48, 50.0)] * 2
    np.save(tmp_path / "b" / "poses_bounds.npy", rows)
    for name in "ab":
        with pytest.raises(UserError, match="64x48, its given camera 48x64"):
            given_model(look(tmp_path / name))


def test_malformed_poses_are_a_user_error_unless_ignored(tmp_path):
    photos(tmp_path / "images", 2)
    (tmp_path / "transforms.json").write_text("{")
    with pytest.raises(UserError, match="line 1"):
        look(tmp_path)
    assert len(look(tmp_path, config(poses="ignore")).photos) == 2
    bad = np.eye(4)
    bad[0, 0] = np.nan
    content = {"fl_x": 50, "frames": [frame(path="images/p00.jpg"), frame(bad, "images/p01.jpg")]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"p01\.jpg"):
        look(tmp_path)


def test_an_incomplete_model_is_a_warning(tmp_path):
    photos(tmp_path / "images", 2)
    write_sparse(tmp_path / "sparse" / "0", ["p00.jpg"], (64, 48))
    (tmp_path / "sparse" / "0" / "images.bin").unlink()
    result = look(tmp_path)
    assert result.poses is None
    assert any("images" in line and "sparse/0" in line for line in result.warnings)


def test_circular_symbolic_links_are_followed_once(tmp_path):
    photos(tmp_path / "images", 2)
    (tmp_path / "images" / "again").symlink_to(tmp_path / "images")
    assert names(look(tmp_path)) == ["p00.jpg", "p01.jpg"]


def test_poses_without_folders_are_those_of_the_photographs_in_several(tmp_path):
    """The same positions photographed in different light."""
    for folder in ("midday", "night"):
        photos(tmp_path / folder, 3)
    write_sparse(tmp_path / "sparse" / "0", [f"p0{i}.jpg" for i in range(3)], (64, 48))
    result = look(tmp_path)
    assert any("each is used for the 2 photographs of its name" in line for line in result.warnings)
    images = given_model(result).model.by_name()
    assert sorted(images) == names(result) and len(images) == 6
    assert (images["midday/p02.jpg"].centre == images["night/p02.jpg"].centre).all()
    picture(tmp_path / "night" / "p09.jpg")
    (tmp_path / "midday" / "p02.jpg").unlink()
    with pytest.raises(UserError, match=r"p00.jpg may mean .*: midday/p00.jpg, night/p00.jpg"):
        look(tmp_path)


def test_poses_of_photographs_that_were_in_other_folders(tmp_path):
    photos(tmp_path / "images" / "left", 2)
    photos(tmp_path / "images" / "right", 2)
    listed = [f"D:\\site\\{side}\\p0{i}.JPG" for side in ("right", "left") for i in range(2)]
    write_sparse(tmp_path / "sparse" / "0", listed, (64, 48))
    images = given_model(look(tmp_path)).model.by_name()
    depth = {name: image.translation[2] for name, image in images.items()}
    expected = {"right/p00.jpg": 0, "right/p01.jpg": 1, "left/p00.jpg": 2, "left/p01.jpg": 3}
    assert depth == expected
