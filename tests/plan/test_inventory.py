"""Every file of a scene folder is used, or named with the reason."""

from __future__ import annotations

import json
import shutil
import time
import unicodedata
from pathlib import Path, PurePosixPath

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from PIL import Image

from pipeline.io import walk as walks
from pipeline.io.colmap import read_model, write_model
from pipeline.io.companions import DEPTHS
from pipeline.io.names import PHOTO_SUFFIXES, first_names, suffix_of
from pipeline.plan.inventory import _SIDE_CARS, _TEXTS
from pipeline.runtime.errors import UserError
from tests.io.test_transforms import frame, write
from tests.pictures import photos, picture
from tests.plan.test_scan import look, names, write_sparse

SIZE = (64, 48)
MODEL_STEMS = ("cameras", "images", "points3D", "rigs", "frames")
# Contents of files: a picture, and a link to nothing.
PICTURE, LINK = "picture", "link"


@pytest.fixture(scope="module")
def small_scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("inventory")
    photos(folder / "images", 3)
    for i in range(2):
        picture(folder / "masks" / f"p0{i}.png", mode="L")
    write_sparse(folder / "sparse" / "0", [f"p0{i}.jpg" for i in range(3)], SIZE)
    return folder


# fmt: off
FOLDERS = st.sampled_from([
    ".", "images", "images/a", "images_2", "input", "orig", "color", "keyframes", "a/b/c", "Köln",
    unicodedata.normalize("NFD", "Köln"), "masks", "masks/b", "mask", "Masks", "Masken",
    "segmentation", "images/masks", "depths", "depth", "sparse", "sparse/0", "sparse/1",
    "colmap/sparse/0", "distorted/sparse/0", "sparse_gt", "depth_gt", "videos", "points",
])
STEMS = st.one_of(
    st.sampled_from([
        "p00", "P00", "p02", "p00_mask", "p01.jpg", "p02_depth", "x", "é",
        unicodedata.normalize("NFD", "é"), "transform", "transforms", "transforms_train", "cameras",
        "camera", "images", "points3D", "rigs", "geo", "gps", "gcp", "gcp_list", "GCP_list",
        "points", "cloud", "poses_bounds", "metadata", "bundle.out", "reconstruction", "Model",
        "internal_external", "readme2", "pano",
    ]),
    st.text(st.characters(codec="utf-8", exclude_characters="/.\\", exclude_categories=["C"])),
)
ENDINGS = st.sampled_from([
    ".png", ".PNG", ".jpg", ".JPEG", ".jfif", ".jpe", ".tif", ".webp", ".heic", ".gif", ".exr",
    ".insp", ".dng", ".xml", ".json", ".txt", ".csv", ".npy", ".NPY", ".npz", ".bin", ".mp4",
    ".MOV", ".mts", ".mpg", ".ply", ".las", ".e57", ".pfm", ".zip", ".bak", ".yaml", ".pdf", "",
])
CONTENTS = st.sampled_from([
    b"", b"some content that no reader expects", PICTURE, LINK,
    "<?xml version='1.0' encoding='UTF-16'?><document/>".encode("utf-16"), b"[]", b"\0" * 64,
])
# fmt: on


def put(path: Path, content: bytes | str) -> None:
    """Write one of ``CONTENTS``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if content == PICTURE:
        Image.new("L", SIZE, 200).save(path, format="PNG" if suffix_of(path.name) else "JPEG")
    elif content == LINK:
        path.symlink_to("nothing")
    else:
        assert isinstance(content, bytes)
        path.write_bytes(content)


def is_no_input(path: PurePosixPath) -> bool:
    """Whether the guides say that a file of this path is not for reconstruction."""
    return (
        path.name[0] == "."
        or suffix_of(path.name) in _SIDE_CARS
        or path.stem.casefold() in _TEXTS
        # Reduced copies of photographs, which the reason for the choice of the folder names.
        or (path.parts[0] == "images_2" and suffix_of(path.name) in PHOTO_SUFFIXES)
        # Parts of the COLMAP model that is used, and ground truth.
        or (path.parts[0] == "sparse_gt" and path.stem in MODEL_STEMS)
        or (path.parts[0] == "depth_gt" and suffix_of(path.name) in DEPTHS.suffixes)
        or (path.parent.as_posix() == "sparse/0" and path.stem in ("rigs", "frames"))
        or path.as_posix() == "sparse/0/points3D.ply"
    )


@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@example("distorted/sparse/0", "cameras", ".bin", b"")
@example("Köln", "transforms", ".json.bak", b"[]")
@example("masks", "p00_mask", ".png", PICTURE)
@example("sparse/0", "images", ".txt", b"")
@example(".", "GCP_list", ".txt", b"")
@example(".", "cameras", ".xml", "<a/>".encode("utf-16"))
@example("images", "p02", ".jfif", LINK)
@given(FOLDERS, STEMS, ENDINGS, CONTENTS)
def test_any_file_is_used_or_named(small_scene, tmp_path_factory, folder, stem, ending, content):
    """A warning or an error names the file, or the scene is another one with it."""
    relative = PurePosixPath(folder) / (f"{stem[:40]}{ending}".strip() or "x")
    scene = tmp_path_factory.mktemp("any") / "scene"
    shutil.copytree(small_scene, scene)
    path = scene / relative
    if is_no_input(relative) or path.exists():
        shutil.rmtree(scene.parent)
        return
    before = look(scene)
    put(path, content)
    used, error = False, ""
    try:
        after = look(scene)
    except UserError as found:
        lines, error = found.warnings, str(found)
    else:
        lines = after.warnings
        used = after.fingerprint != before.fingerprint
    finally:
        shutil.rmtree(scene.parent)
    name = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in relative.name)
    escaped = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in relative.name)
    named = any(name in line for line in lines if line not in before.warnings)
    assert named or used or name in error or escaped in error, (relative, lines, error)


def test_each_kind_is_named_with_its_reason(tmp_path):
    photos(tmp_path / "images", 3)
    write(tmp_path, {"fl_x": 50, "frames": [frame(path=f"images/p0{i}.jpg") for i in range(2)]})
    for name in (
        "geo.txt", "gcp.txt", "camera.xml.bak", "transform.json", "images/pano.insp",
        "distorted/sparse/0/cameras.bin", "notes.pdf", "old/walk.mp4", "scan.ply",
    ):  # fmt: skip
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"content")
    picture(tmp_path / "Masks_old" / "p00.png", mode="L")
    picture(tmp_path / "orig" / "p00.png")
    warnings = look(tmp_path).warnings
    expected = {
        "geo.txt": "positions are read from EXIF",
        "gcp.txt": "positions are read from EXIF",
        "camera.xml.bak": "no pose file has this name",
        "transform.json": "no pose file has this name",
        "images/pano.insp": "convert them",
        "distorted/sparse/0/cameras.bin": "COLMAP model",
        "notes.pdf": "no input has this name",
        "old/walk.mp4": "videos are read from",
        "scan.ply": "init.points_file",
        "Masks_old/p00.png": "masks belong into masks/",
        "orig/p00.png": "the photographs of images/ are used",
        "images/p02.jpg": "transforms.json lists other photographs only",
    }
    for name, reason in expected.items():
        (line,) = (line for line in warnings if name in line)
        assert reason in line, line


def test_files_that_are_not_for_reconstruction_are_no_warning(tmp_path):
    photos(tmp_path / "images", 3)
    photos(tmp_path / "images_2", 3)
    for name in ("README.txt", "LICENSE", ".DS_Store", "Thumbs.db", "images/p00.xmp", "demo.json"):
        (tmp_path / name).write_text("text")
    assert look(tmp_path).warnings == ()


def test_stray_files_change_no_result(tmp_path):
    photos(tmp_path / "images", 3)
    before = look(tmp_path)
    (tmp_path / "notes.pdf").write_bytes(b"")
    after = look(tmp_path)
    assert before.fingerprint == after.fingerprint and before.manifest == after.manifest
    assert "notes.pdf is not used" in after.warnings[0]


def test_many_stray_files_are_one_short_line(tmp_path):
    photos(tmp_path / "images", 2)
    (tmp_path / "cache").mkdir()
    for i in range(5000):
        (tmp_path / "cache" / f"{i:05d}.dat").touch()
    start = time.monotonic()
    (line,) = look(tmp_path).warnings
    assert line.startswith("5000 files are not used (first: cache/00000.dat") and len(line) < 300
    assert time.monotonic() - start < 20


def test_links_to_folders_above_are_not_followed(tmp_path):
    photos(tmp_path / "scene" / "images", 2)
    (tmp_path / "scene" / "images" / "root").symlink_to("/")
    found = look(tmp_path / "scene")
    assert names(found) == ["p00.jpg", "p01.jpg"]
    assert "images/root/ is not used: it is a link to /" in found.warnings[0]


def test_links_to_too_many_files_are_an_error_that_names_the_link(tmp_path, monkeypatch):
    photos(tmp_path / "scene" / "images", 2)
    (tmp_path / "many").mkdir()
    for i in range(50):
        (tmp_path / "many" / f"{i}.txt").touch()
    (tmp_path / "scene" / "images" / "more").symlink_to(tmp_path / "many")
    monkeypatch.setattr(walks, "MAX_ENTRIES", 40)
    with pytest.raises(UserError, match="at most 40 files below, found more by this link") as error:
        look(tmp_path / "scene")
    assert error.value.file == tmp_path / "scene" / "images" / "more"


def test_a_scene_of_links_is_used(tmp_path):
    photos(tmp_path / "shared", 3)
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "images").symlink_to(tmp_path / "shared")
    found = look(tmp_path / "scene")
    assert names(found) == ["p00.jpg", "p01.jpg", "p02.jpg"] and not found.warnings


# --- models -------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [False, True])
def test_of_several_models_the_one_with_the_most_photographs_is_used(tmp_path, text):
    photos(tmp_path / "images", 4)
    write_sparse(tmp_path / "sparse" / "0", ["p00.jpg"], SIZE)
    write_sparse(tmp_path / "sparse" / "1", [f"p0{i}.jpg" for i in range(1, 4)], SIZE)
    for name in ("0", "1"):
        folder = tmp_path / "sparse" / name
        write_model(folder, read_model(folder), text=text)
    found = look(tmp_path)
    assert found.poses is not None and found.poses.path == "sparse/1"
    (line,) = (line for line in found.warnings if "of 2 COLMAP models" in line)
    assert "sparse/1 (3 images) is used, which has the most photographs" in line
    assert "not used: sparse/0 (1 images)" in line


@pytest.mark.parametrize("text", [False, True])
def test_images_of_other_scenes_do_not_count_in_the_choice_of_a_model(tmp_path, text):
    photos(tmp_path / "images", 3)
    write_sparse(tmp_path / "sparse" / "0", ["p00.jpg", *(f"q{i}.jpg" for i in range(5))], SIZE)
    write_sparse(tmp_path / "sparse" / "1", [f"p0{i}.jpg" for i in range(3)], SIZE)
    for name in ("0", "1"):
        model = read_model(tmp_path / "sparse" / name)
        write_model(tmp_path / "sparse" / name, model, text=text)
    found = look(tmp_path)
    assert found.poses is not None and found.poses.path == "sparse/1"
    assert any("not used: sparse/0 (1 of 6 images)" in line for line in found.warnings)


def test_text_files_beside_binary_ones_are_named(tmp_path):
    photos(tmp_path / "images", 3)
    model = tmp_path / "sparse" / "0"
    write_sparse(model, [f"p0{i}.jpg" for i in range(3)], SIZE)
    (model / "images.txt").write_text("# from another program\n")
    (line,) = look(tmp_path).warnings
    assert line == "sparse/0 has binary and text files; the binary ones are used, not images.txt"


def test_a_damaged_model_is_an_error_if_it_has_the_most_images(tmp_path):
    photos(tmp_path / "images", 3)
    write_sparse(tmp_path / "sparse" / "0", [f"p0{i}.jpg" for i in range(3)], SIZE)
    write_sparse(tmp_path / "sparse" / "1", ["p00.jpg"], SIZE)
    images = tmp_path / "sparse" / "0" / "images.bin"
    images.write_bytes(images.read_bytes()[:-20])
    with pytest.raises(UserError, match="ends too early") as error:
        look(tmp_path)
    assert error.value.file == images


def test_the_model_before_undistortion_is_used_with_its_photographs(tmp_path):
    photos(tmp_path / "input", 3)
    write_sparse(tmp_path / "distorted/sparse/0", [f"p0{i}.jpg" for i in range(3)], SIZE)
    found = look(tmp_path)
    assert found.poses is not None and found.poses.path == "distorted/sparse/0"
    (tmp_path / "input").rename(tmp_path / "images")
    found = look(tmp_path)
    assert found.poses is None
    assert any("distorted/sparse/0/images" in line for line in found.warnings)


def test_first_names():
    assert first_names(["a"], 2) == "a" and first_names(["a", "b", "c"], 2) == "a, b and 1 more"


def test_scans_of_other_programs_are_used_with_their_depth_maps(tmp_path):
    """ScanNet has smaller maps in depth/; Polycam has keyframes/depth/."""
    for i in range(3):
        picture(tmp_path / "a" / "color" / f"{i}.jpg")
        picture(tmp_path / "a" / "depth" / f"{i}.png", (32, 24), mode="L")
        pose = tmp_path / "a" / "pose" / f"{i}.txt"
        pose.parent.mkdir(exist_ok=True)
        pose.write_text(f"1 0 0 {i}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    (tmp_path / "a" / "intrinsic").mkdir()
    for name in ("intrinsic_color", "intrinsic_depth"):
        lens = "50 0 32 0\n0 50 24 0\n0 0 1 0\n0 0 0 1\n"
        (tmp_path / "a" / "intrinsic" / f"{name}.txt").write_text(lens)
    found = look(tmp_path / "a")
    depths = [str(tmp_path / "a" / "depth" / f"{i}.png") for i in range(3)]
    assert [photo.depth for photo in found.photos] == depths
    (line,) = found.warnings
    assert line.startswith("intrinsic/intrinsic_depth.txt is not used")
    assert "or the set of ScanNet poses comes first" in line

    frames = tmp_path / "b" / "keyframes"
    for i in range(3):
        picture(frames / "corrected_images" / f"{i}.jpg")
        picture(frames / "depth" / f"{i}.png", (32, 24), mode="L")
        camera = {
            f"t_{r}{c}": float(r == c) + i * (r == 0 and c == 3) for r in range(3) for c in range(4)
        }
        camera |= {"fx": 50, "fy": 50, "cx": 32, "cy": 24, "width": 64, "height": 48}
        (frames / "corrected_cameras").mkdir(exist_ok=True)
        (frames / "corrected_cameras" / f"{i}.json").write_text(json.dumps(camera))
    found = look(tmp_path / "b")
    depths = [str(frames / "depth" / f"{i}.png") for i in range(3)]
    assert [photo.depth for photo in found.photos] == depths and not found.warnings


# --- errors -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, content, first",
    [
        ("GCP_list.txt", b"EPSG:32632\nnonsense", "line 2"),
        ("transforms.json", b"{", "transforms.json"),
        ("poses_bounds.npy", b"nonsense", "poses_bounds.npy"),
        ("masks/p00.png", b"", "masks/p00.png"),
    ],
)
def test_an_error_in_one_file_does_not_hide_the_others(tmp_path, name, content, first):
    photos(tmp_path / "images", 3)
    (tmp_path / "masks").mkdir()
    (tmp_path / name).write_bytes(content)
    (tmp_path / "geo.txt").write_bytes(b"content")
    picture(tmp_path / "Masks_old" / "p00.png", mode="L")
    with pytest.raises(UserError, match=first) as error:
        look(tmp_path)
    named = [line for line in error.value.warnings if "not used" in line]
    assert sum("geo.txt" in line for line in named) == 1
    if name.startswith("masks"):  # Its masks are unknown.
        assert len(named) == 1
    else:
        assert sum("Masks_old/p00.png" in line for line in named) == 1 and len(named) == 2


def test_errors_in_two_files_are_both_shown(tmp_path):
    photos(tmp_path / "images", 3)
    (tmp_path / "GCP_list.txt").write_text("EPSG:32632\nnonsense")
    picture(tmp_path / "masks" / "p00.png", size=(8, 8), mode="L")
    with pytest.raises(UserError, match="the mask is 8x8") as error:
        look(tmp_path)
    assert any("GCP_list.txt: line 2" in line for line in error.value.warnings)
