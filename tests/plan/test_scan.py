"""Scanning a scene folder: supported layouts, EXIF data, fingerprints, errors."""

import dataclasses
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.config.schema import Config
from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import read_model, write_model
from pipeline.plan.given_poses import GivenModel, load_given
from pipeline.plan.scan import Scan, scan
from pipeline.plan.settle import settle
from pipeline.runtime.errors import UserError
from pipeline.scene.normalization import Normalization
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from tests.io.test_llff import llff_row
from tests.io.test_transforms import frame, write
from tests.pictures import photos, picture


def look(folder: Path, config: Config | None = None, cache: Path | None = None) -> Scan:
    found = scan(folder, folder.name, config or Config(), cache=cache)
    assert str(folder) not in "".join(found.warnings), "a warning holds a path of this machine"
    return found


def config(**sections) -> Config:
    return Config.model_validate(sections)


def given_model(result: Scan) -> GivenModel:
    assert result.poses is not None
    return load_given(
        result.folder / result.poses.path,
        result.poses.kind,
        result.photos,
        listed=result.listed,
        base_folder=result.base_folder,
    )


def names(result: Scan) -> list[str]:
    return [photo.name for photo in result.photos]


def write_sparse(
    folder: Path, photo_names: list[str], size: tuple[int, int], model: str = "PINHOLE"
) -> None:
    """A COLMAP model with one point, observed at the centre of each photograph."""
    count = len(photo_names)
    params = {"PINHOLE": [50.0, 50, size[0] / 2, size[1] / 2]}
    params["SIMPLE_RADIAL"] = [50.0, size[0] / 2, size[1] / 2, 0.1]
    images = {
        i + 1: PosedImage(name, 1, np.eye(3), np.array([0.0, 0, i]))
        for i, name in enumerate(photo_names)
    }
    points = Points(
        np.zeros((1, 3)),
        np.zeros((1, 3), np.uint8),
        np.zeros(1),
        np.array([0, count]),
        np.arange(1, count + 1),
        np.tile(np.array(size) / 2, (count, 1)),
    )
    cameras = {1: Camera(model, *size, np.array(params[model]))}
    write_model(folder, Reconstruction(cameras, images, points))


# --- layouts ------------------------------------------------------------------------------


def test_images_folder_with_subfolders(tmp_path):
    picture(tmp_path / "images" / "b" / "x.PNG")
    picture(tmp_path / "images" / "a.jpeg")
    picture(tmp_path / "images" / ".hidden.jpg")
    (tmp_path / "images" / "notes.md").write_text("no picture")
    for preview in ("@eaDir", "Thumbnails", ".thumbs", "__MACOSX"):
        picture(tmp_path / "images" / preview / "a.jpeg")
    for side_car in ("a.xmp", "a.jpeg.pp3", "a.thm", "._a.jpeg"):
        (tmp_path / "images" / side_car).write_text("facts about a.jpeg")
    result = look(tmp_path)
    assert (names(result), result.image_folder) == (["a.jpeg", "b/x.PNG"], "images")
    assert (result.poses, result.truth, result.warnings) == (None, None, ())
    assert Path(result.photos[1].path) == tmp_path / "images" / "b" / "x.PNG"


def test_plain_folder_of_photographs(tmp_path):
    photos(tmp_path, 3)
    picture(tmp_path / "masks" / "p00.png", mode="L")
    result = look(tmp_path)
    assert (names(result), result.image_folder) == (["p00.jpg", "p01.jpg", "p02.jpg"], ".")
    assert result.num_masks == 1
    assert "2 of 3 photographs have no mask" in result.warnings


def test_unused_subfolders_are_a_warning(tmp_path):
    photos(tmp_path, 2)
    photos(tmp_path / "others", 1)
    photos(tmp_path / "thumbs", 1)
    (warning,) = look(tmp_path).warnings
    assert "others" in warning and "thumbs" not in warning


def test_photographs_in_subfolders(tmp_path):
    photos(tmp_path / "left", 1)
    photos(tmp_path / "right", 1)
    photos(tmp_path / "masks" / "left", 1, mode="L")
    assert names(look(tmp_path)) == ["left/p00.jpg", "right/p00.jpg"]


def test_a_single_subfolder_with_another_name_is_used(tmp_path):
    photos(tmp_path / "input", 2)
    write_sparse(tmp_path / "sparse" / "0", ["p00.jpg", "p01.jpg"], (64, 48))
    result = look(tmp_path)
    assert (result.image_folder, names(result)) == ("input", ["p00.jpg", "p01.jpg"])


ODD_NAMES = [
    "Screenshot 10.30.00\u202fPM.png",
    "family \N{MAN}\u200d\N{GIRL}.jpg",
    "no\u00a0break.jpg",
    "two words.jpg",
    "-rf.jpg",
    "{scene}.jpg",
    'it\'s "quoted".jpg',
    "a#b;c&d.jpg",
    "Größe 写真.jpg",
    "aa/aa/aa.jpg",
    "100%.jpg",
    "$HOME.jpg",
]


def test_photographs_with_odd_names_are_used(tmp_path):
    for name in ODD_NAMES:
        picture(tmp_path / "images" / name)
    result = look(tmp_path)
    assert (names(result), result.warnings) == (sorted(ODD_NAMES), ())


def test_photographs_in_several_folders_share_cameras_by_folder(tmp_path):
    """Two cameras of one model have the same EXIF data, but not the same lens distortion."""
    for folder in ("left", "right"):
        photos(tmp_path / "images" / folder, 6)
    assert settle(look(tmp_path), config()).config.sfm.share_cameras == "folder"
    picture(tmp_path / "images" / "one" / "p.jpg")  # too few to determine a camera
    assert settle(look(tmp_path), config()).config.sfm.share_cameras == "group"


@pytest.mark.parametrize(
    "long_side, chosen", [(960, "images"), (32, "images_2"), (16, "images_4"), (1, "images_4")]
)
def test_smaller_copies_match_the_model_by_stem(tmp_path, long_side, chosen):
    photos(tmp_path / "images", 2, (64, 48))
    for n in (2, 4):
        for name in ("p00.png", "p01.png"):
            picture(tmp_path / f"images_{n}" / name, (64 // n, 48 // n))
    write_sparse(tmp_path / "sparse" / "0", ["p00.jpg", "p01.jpg"], (64, 48))
    result = look(tmp_path, config(views={"max_long_side_px": long_side}))
    assert result.image_folder == chosen
    model = given_model(result).model
    size = (result.photos[0].width, result.photos[0].height)
    assert sorted(model.by_name()) == names(result)
    (camera,) = model.cameras.values()
    assert (camera.width, camera.height) == size
    assert camera.pinhole == (50 * size[0] / 64, 50 * size[0] / 64, size[0] / 2, size[1] / 2)
    np.testing.assert_allclose(model.points.track_xy, [np.array(size) / 2] * 2)


@pytest.mark.parametrize(
    ("scene", "chosen"),
    [("garden", "images_4"), ("mip360_bonsai", "images_2"), ("360_v2-room", "images_2")],
)
def test_scenes_of_mip_nerf_360_have_the_size_that_papers_use(tmp_path, scene, chosen):
    folder = tmp_path / scene
    for n in (1, 2, 4, 8):
        name = "images" if n == 1 else f"images_{n}"
        photos(folder / name, 2, (64 // n, 48 // n))
    result = look(folder, config(views={"max_long_side_px": 1}))
    assert result.image_folder == chosen
    assert "Mip-NeRF 360" in result.image_folder_reason
    shutil.rmtree(folder / chosen)
    assert look(folder, config(views={"max_long_side_px": 64})).image_folder == "images"


def test_without_poses_images_are_large_enough_for_features(tmp_path):
    photos(tmp_path / "images", 2, (64, 48))
    photos(tmp_path / "images_2", 2, (32, 24))
    small = {"max_long_side_px": 32}
    assert look(tmp_path, config(views=small)).image_folder == "images"
    assert look(tmp_path, config(views=small, features=small)).image_folder == "images_2"


def test_smaller_copies_without_all_masks_and_photographs_are_not_used(tmp_path):
    small = config(views={"max_long_side_px": 32}, features={"max_long_side_px": 32})
    photos(tmp_path / "images", 3, (64, 48))
    photos(tmp_path / "images_2", 2, (32, 24))
    assert look(tmp_path, small).image_folder == "images"
    photos(tmp_path / "images_2", 3, (32, 24))
    photos(tmp_path / "masks", 3, (64, 48), mode="L")
    assert look(tmp_path, small).image_folder == "images"
    photos(tmp_path / "masks_2", 3, (32, 24), mode="L")
    result = look(tmp_path, small)
    assert (result.image_folder, result.num_masks) == ("images_2", 3)


def test_only_a_smaller_copy_exists(tmp_path):
    photos(tmp_path / "images_4", 2, (16, 12))
    write_sparse(tmp_path / "sparse", ["p00.JPG", "p01.JPG"], (64, 48))
    result = look(tmp_path)
    assert (result.image_folder, result.poses.path) == ("images_4", "sparse")
    assert next(iter(given_model(result).model.cameras.values())).width == 16


def test_configured_folder(tmp_path):
    photos(tmp_path / "images", 2, (64, 48))
    photos(tmp_path / "images_2", 2, (32, 24))
    result = look(tmp_path, config(inspect={"image_folder": "images_2"}))
    assert (result.image_folder, result.sizes) == ("images_2", [(32, 24)])
    for wrong in ("imgs", "..", str(tmp_path)):
        with pytest.raises(UserError, match="image_folder") as error:
            look(tmp_path, config(inspect={"image_folder": wrong}))
        assert "images_2" in error.value.fix


def test_given_colmap_model_and_truth(tmp_path):
    files = photos(tmp_path / "images", 3)
    listed = [path.name for path in files]
    write_sparse(tmp_path / "sparse" / "0", [*listed[:2], "gone.jpg"], (64, 48), "SIMPLE_RADIAL")
    write_sparse(tmp_path / "sparse_gt", listed, (64, 48))
    result = look(tmp_path)
    poses = result.poses
    assert (poses.kind, poses.path, poses.num_points) == ("colmap", "sparse/0", 1)
    assert (poses.models, poses.pinhole) == (("SIMPLE_RADIAL",), False)
    assert result.truth == tmp_path / "sparse_gt"
    assert any("gone.jpg" in line for line in result.warnings)
    assert any("p02.jpg" in line and "no given pose" in line for line in result.warnings)
    model = given_model(result).model
    assert sorted(model.by_name()) == listed[:2]
    assert model.points.track_length.tolist() == [2]
    assert look(tmp_path, config(poses="ignore")).poses is None


@pytest.mark.parametrize(("away", "moved"), [(0.0, False), (50.0, False), (1e5, True), (1e9, True)])
def test_poses_far_from_the_origin_are_translated(tmp_path, away, moved):
    """At 1e5 times a scene's size from the origin, float32 cannot resolve a pixel. Projections do
    not change, and the translation is recorded."""
    files = photos(tmp_path / "images", 4)
    folder = tmp_path / "sparse" / "0"
    write_sparse(folder, [path.name for path in files], (64, 48))
    near, shift = read_model(folder), away * np.array([0.6, -0.64, 0.48])
    images = {
        i: dataclasses.replace(image, translation=image.translation - image.rotation @ shift)
        for i, image in near.images.items()
    }
    points = dataclasses.replace(near.points, xyz=near.points.xyz + shift)
    write_model(folder, Reconstruction(near.cameras, images, points))
    given = given_model(look(tmp_path))
    origin = given.normalization.origin
    assert bool(origin.any()) == moved == (given.georeference() is not None)
    for i, image in given.model.images.items():
        local = image.rotation @ given.model.points.xyz[0] + image.translation
        np.testing.assert_allclose(local, near.images[i].translation, atol=1e-15 * away + 1e-12)
    if moved:
        assert np.abs(given.model.points.xyz).max() < 10
        assert (origin == np.round(origin)).all()
        back = given.model.points.xyz[0] + origin
        np.testing.assert_allclose(back, shift, rtol=1e-12)
        assert [*given.georeference().origin.model_dump().values()] == origin.tolist()


@pytest.mark.parametrize(
    ("unit", "scale"), [(1.0, 1.0), (20.0, 1.0), (1e3, 1e-3), (1e-3, 1e3), (1e-6, 1e6), (1e9, 1e-9)]
)
def test_poses_in_an_extreme_unit_are_scaled_by_a_power_of_1000(tmp_path, unit, scale):
    """Millimetres give the same numbers as metres; poses of moderate size keep their bits."""
    files = photos(tmp_path / "images", 4)
    folder = tmp_path / "sparse" / "0"
    write_sparse(folder, [path.name for path in files], (64, 48))
    metres = read_model(folder)
    there = Normalization(1 / unit)
    write_model(folder, there.model_to_given(metres))
    given = given_model(look(tmp_path))
    assert given.normalization.scale == pytest.approx(scale, rel=1e-15)
    assert (given.georeference() is None) == (scale == 1)
    for i, image in given.model.images.items():
        expected = metres.images[i].translation * unit * scale
        np.testing.assert_allclose(image.translation, expected, rtol=1e-14)
        if unit == 1:
            assert (image.translation == metres.images[i].translation).all()


def test_positions_that_overflow_are_a_user_error(tmp_path):
    files = photos(tmp_path / "images", 3)
    folder = tmp_path / "sparse" / "0"
    write_sparse(folder, [path.name for path in files], (64, 48))
    write_model(folder, Normalization(1e-200).model_to_given(read_model(folder)))
    with pytest.raises(UserError, match=r"at most 1e\+18 units from the origin"):
        given_model(look(tmp_path))


@pytest.mark.parametrize(("focal", "ok"), [(1.0, False), (2.0, True), (6e4, True), (1e9, False)])
def test_an_impossible_focal_length_is_a_user_error(tmp_path, focal, ok):
    files = photos(tmp_path / "images", 2)
    folder = tmp_path / "sparse" / "0"
    write_sparse(folder, [path.name for path in files], (64, 48))
    model = read_model(folder)
    camera = dataclasses.replace(model.cameras[1], params=np.array([focal, focal, 32, 24]))
    write_model(folder, dataclasses.replace(model, cameras={1: camera}))
    if ok:
        assert given_model(look(tmp_path)).model.cameras[1].pinhole[0] == focal
    else:
        with pytest.raises(UserError, match="focal length of"):
            given_model(look(tmp_path))


def test_truth_is_never_an_input(tmp_path):
    files = photos(tmp_path / "images", 2)
    before = look(tmp_path)
    write_sparse(tmp_path / "sparse_gt", [path.name for path in files], (64, 48))
    after = look(tmp_path)
    assert after.poses is None and after.fingerprint == before.fingerprint
    assert before.truth_digest is None and after.truth_digest is not None


def test_nerf_synthetic(tmp_path):
    for split in ("train", "test"):
        for i in range(2):
            picture(tmp_path / split / f"r_{i}.png", mode="RGBA")
        picture(tmp_path / split / "r_0_depth_0001.png")
        frames = [frame(path=f"./{split}/r_{i}") for i in range(3)]
        write(tmp_path, {"camera_angle_x": 0.7, "frames": frames}, f"transforms_{split}.json")
    result = look(tmp_path)
    expected = ["test/r_0.png", "test/r_1.png", "train/r_0.png", "train/r_1.png"]
    assert names(result) == expected == sorted(given_model(result).model.by_name())
    assert (result.num_alpha, result.poses.kind, result.poses.pinhole) == (4, "transforms", True)
    assert any("2 of 6 poses have no photograph" in line for line in result.warnings)
    assert names(look(tmp_path, config(poses="ignore"))) == expected


def test_nerfstudio_with_masks(tmp_path):
    photos(tmp_path / "images", 2)
    photos(tmp_path / "m", 2, mode="L")
    frames = [frame(path=f"images/p0{i}.jpg", mask_path=f"m/p0{i}.jpg") for i in range(2)]
    write(tmp_path, {"fl_x": 50, "w": 128, "h": 96, "k1": 0.1, "frames": frames})
    result = look(tmp_path)
    assert (result.image_folder, names(result)) == ("images", ["p00.jpg", "p01.jpg"])
    assert (result.num_masks, result.poses.models) == (2, ("OPENCV",))
    (camera,) = given_model(result).model.cameras.values()
    assert (camera.width, camera.pinhole[0]) == (64, 25)


def test_transforms_with_absolute_paths_and_photographs_elsewhere(tmp_path):
    folder = tmp_path / "scene"
    photos(folder / "images", 2)
    photos(tmp_path / "other", 2)
    inside = [str(folder / "images" / "p00.jpg"), "images/../images/p01.jpg"]
    outside = [str(tmp_path / "other" / "p00.jpg"), "../other/p01.jpg"]
    frames = [frame(path=path) for path in inside + outside]
    write(folder, {"fl_x": 50, "frames": frames})
    result = look(folder)
    assert names(result) == ["p00.jpg", "p01.jpg"] == sorted(given_model(result).model.by_name())
    assert any("2 of 4 poses have no photograph" in line for line in result.warnings)


def test_llff_order_includes_unreadable_photographs(tmp_path):
    photos(tmp_path / "images", 3)
    (tmp_path / "images" / "p01.jpg").write_text("not a picture")
    rows = [llff_row(np.eye(3), np.array([i, 0.0, 0]), 48, 64, 50.0) for i in range(3)]
    np.save(tmp_path / "poses_bounds.npy", rows)
    result = look(tmp_path)
    assert result.poses.kind == "llff"
    centres = {name: image.centre[0] for name, image in given_model(result).model.by_name().items()}
    assert centres == {"p00.jpg": 0, "p02.jpg": 2}
    picture(tmp_path / "images" / "p03.jpg")
    with pytest.raises(UserError, match="3 poses and 4 photographs in images/"):
        look(tmp_path)


def test_masks_as_colmap_names_them(tmp_path):
    photos(tmp_path / "images", 2)
    picture(tmp_path / "masks" / "p00.jpg.png", mode="L")
    picture(tmp_path / "masks" / "P01.png", mode="L")
    result = look(tmp_path)
    found = [Path(photo.mask).name for photo in result.photos]
    assert found == ["p00.jpg.png", "P01.png"]
    assert look(tmp_path, config(views={"masks": "ignore"})).num_masks == 0


def test_depths(tmp_path):
    photos(tmp_path / "images", 2)
    (tmp_path / "depths").mkdir()
    np.save(tmp_path / "depths" / "p00.npy", np.zeros((48, 64)))
    assert [photo.depth for photo in look(tmp_path).photos] == [
        str(tmp_path / "depths" / "p00.npy"),
        None,
    ]


# --- facts --------------------------------------------------------------------------------

NIKON = {0x010F: "NIKON CORPORATION", 0x0110: "NIKON D60"}


def test_exif_facts(tmp_path):
    exif = {0x920A: 29.0, 0xA405: 43, 0x9003: "2011:05:02 17:24:09", 0xA434: "18-55mm"}
    gps = {1: "S", 2: (10.0, 30.0, 36.0), 3: "W", 4: (20.0, 0.0, 0.0), 5: b"\1", 6: 12.5}
    picture(tmp_path / "a.jpg", exif=exif, gps=gps, tags={**NIKON, 0x0112: 6})
    picture(tmp_path / "b.png", mode="RGBA")
    a, b = look(tmp_path).photos
    assert (a.width, a.height, a.orientation) == (64, 48, 6)
    assert a.camera_group == "NIKON D60 | 18-55mm | 29 mm | 64x48"
    # The diagonals are 43.27 mm and 80 pixels.
    assert a.focal_px == pytest.approx(43 / 43.27 * 80)
    assert a.gps == pytest.approx((-10.51, -20.0, -12.5))
    assert a.taken == "2011-05-02T17:24:09"
    assert (b.camera_group, b.focal_px, b.gps, b.taken, b.alpha) == (
        "64x48",
        None,
        None,
        None,
        True,
    )


def test_an_opaque_alpha_channel_is_ignored(tmp_path):
    """The scene must be trained over the same background as its copy in RGB."""
    (tmp_path / "images").mkdir()
    for i, (mode, least) in enumerate((("RGBA", 255), ("RGBA", 254), ("LA", 255), ("LA", 0))):
        image = Image.new(mode, (64, 48), "gray")
        alpha = Image.new("L", (64, 48), 255)
        alpha.putpixel((63, 47), least)
        image.putalpha(alpha)
        image.save(tmp_path / "images" / f"{i}.png")
    assert [photo.alpha for photo in look(tmp_path).photos] == [False, True, False, True]


@pytest.mark.parametrize(
    "exif, focal",
    [
        # 6400 pixels at 20 pixels per mm, resized to 64.
        ({0x920A: 50.0, 0xA20E: 200.0, 0xA210: 4, 0xA002: 6400, 0xA003: 4800}, 100.0),
        ({0x920A: 50.0, 0xA20E: 508.0, 0xA210: 2, 0xA002: 640, 0xA003: 480}, 100.0),
        ({0x920A: 50.0, 0xA20E: 9999.0, 0xA002: 64, 0xA003: 48}, None),
        ({0x920A: 50.0}, None),
        ({0xA405: 0, 0x920A: 0.0}, None),
        ({0xA405: 2000}, None),
        # Cropped: the 35 mm equivalent refers to the whole image.
        ({0xA405: 43, 0xA002: 6400, 0xA003: 3600}, None),
    ],
)
def test_focal_lengths_and_their_checks(tmp_path, exif, focal):
    photos(tmp_path, 2, exif=exif)
    found = look(tmp_path).photos[0].focal_px
    assert found == (pytest.approx(focal) if focal else None)


def test_photographs_with_damaged_exif_are_used(tmp_path):
    photos(tmp_path, 2, exif={0xA405: 43})
    file = tmp_path / "p00.jpg"
    data = bytearray(file.read_bytes())
    at = data.index(b"Exif\0\0") + 6
    data[at + 8 : at + 24] = b"\xff" * 16
    file.write_bytes(data)
    result = look(tmp_path)
    assert len(result.photos) == 2 and result.photos[0].focal_px is None


def test_bits(tmp_path):
    import cv2

    tmp_path.joinpath("images").mkdir()
    deep = np.zeros((48, 64, 3), np.uint16)
    for name in ("a.png", "b.tif"):
        assert cv2.imwrite(str(tmp_path / "images" / name), deep)
    picture(tmp_path / "images" / "c.webp")
    Image.fromarray(deep[..., 0]).save(tmp_path / "images" / "d.png")
    assert [photo.bits for photo in look(tmp_path).photos] == [16, 16, 8, 16]


def times(folder: Path, seconds: list[int]) -> Scan:
    for i, second in enumerate(seconds):
        stamp = f"2020:01:01 10:{second // 60:02d}:{second % 60:02d}"
        picture(folder / f"DSC_{i:04d}.jpg", exif={0x9003: stamp})
    return look(folder)


def test_order(tmp_path):
    assert "2 s apart" in times(tmp_path / "walk", [0, 2, 4, 6]).ordered
    assert times(tmp_path / "shuffled", [4, 2, 0, 6]).ordered is None
    assert times(tmp_path / "slow", [0, 60, 120]).ordered is None
    for i in range(4):
        picture(tmp_path / "video" / f"frame_{i:04d}.jpg")
        picture(tmp_path / "collection" / f"{i:04d}.jpg")
    assert "video" in look(tmp_path / "video").ordered
    assert look(tmp_path / "collection").ordered is None


# --- RAW ----------------------------------------------------------------------------------


def write_dng(path: Path, width: int = 64, height: int = 48) -> None:
    """A Bayer DNG with make, model, focal length, colour matrix, black and white level."""
    import tifffile

    rng = np.random.default_rng(list(path.name.encode()))
    matrix = [(1, 1) if i % 4 == 0 else (0, 1) for i in range(9)]
    extra = [
        (271, "s", 0, "Maker", True),
        (272, "s", 0, "Model 1", True),
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, bytes([0, 1, 1, 2]), True),
        (37386, "2I", 1, (35, 1), True),
        (50706, "B", 4, bytes([1, 4, 0, 0]), True),
        (50714, "H", 1, 0, True),
        (50717, "H", 1, 4095, True),
        (50721, "2i", 9, [v for pair in matrix for v in pair], True),
        (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = rng.integers(0, 4096, (height, width), dtype=np.uint16)
    tifffile.imwrite(path, pixels, photometric="CFA", extratags=extra, metadata=None)


def test_of_raw_and_jpeg_pairs_one_is_used(tmp_path):
    for name in ("a.dng", "b.DNG"):
        write_dng(tmp_path / "images" / name)
    picture(tmp_path / "images" / "a.JPG")
    result = look(tmp_path)
    assert (names(result), result.num_linear) == (["a.dng", "b.DNG"], 2)
    photo = result.photos[0]
    assert (photo.width, photo.height, photo.bits) == (64, 48, 16)
    assert photo.camera_group == "Maker Model 1 | ? | 35 mm | 64x48"
    assert "a.JPG" in result.warnings[0]
    write_sparse(tmp_path / "sparse" / "0", ["a.JPG"], (64, 48))
    assert names(look(tmp_path)) == ["a.JPG", "b.DNG"]  # The poses name the JPEG.


def test_the_jpeg_of_an_unreadable_raw_file_is_used(tmp_path):
    photos(tmp_path, 2)
    (tmp_path / "p00.cr2").write_bytes(b"II*\0 nothing")
    result = look(tmp_path)
    (warning,) = result.warnings
    assert "p00.cr2" in warning and "left out" in warning
    assert names(result) == ["p00.jpg", "p01.jpg"]


# --- fingerprint and cache ----------------------------------------------------------------


@pytest.fixture
def scene(tmp_path) -> Path:
    folder = tmp_path / "scene"
    files = photos(folder / "images", 3)
    photos(folder / "masks", 3, mode="L")
    write_sparse(folder / "sparse" / "0", [path.name for path in files], (64, 48))
    return folder


def test_fingerprint_is_independent_of_times_and_location(scene, tmp_path, monkeypatch):
    before = look(scene).fingerprint
    for path in scene.rglob("*"):
        os.utime(path, (1, 1))
    (scene / "images" / "notes.txt").write_text("no picture")
    assert look(scene).fingerprint == before
    shutil.copytree(scene, tmp_path / "elsewhere")
    assert look(tmp_path / "elsewhere").fingerprint == before
    monkeypatch.chdir(tmp_path)
    assert look(Path("scene")).fingerprint == before


@pytest.mark.parametrize("file", ["images/p01.jpg", "masks/p01.jpg", "sparse/0/images.bin"])
def test_fingerprint_changes_with_one_byte(scene, file, tmp_path):
    cache = tmp_path / "cache.json"
    before = look(scene, cache=cache).fingerprint
    time = (scene / file).stat().st_mtime_ns
    data = bytearray((scene / file).read_bytes())
    # The end of a JPEG's scan, or a keypoint's coordinate: still a readable file.
    data[-20] ^= 1
    (scene / file).write_bytes(data)
    os.utime(scene / file, ns=(time, time))  # as cp -p and rsync do
    assert look(scene, cache=cache).fingerprint != before


def test_fingerprint_changes_with_names(scene):
    before = look(scene).fingerprint
    (scene / "masks" / "p02.jpg").unlink()
    without = look(scene).fingerprint
    (scene / "images" / "p02.jpg").rename(scene / "images" / "p02.jpeg")
    assert len({before, without, look(scene).fingerprint}) == 3


def test_scans_are_equal_with_a_missing_or_damaged_cache(scene, tmp_path):
    cache = tmp_path / "cache.json"
    plain = look(scene)
    assert look(scene, cache=cache) == plain == look(scene, cache=cache)
    assert cache.exists()
    for broken in ("", "[]", '{"version": 2}', '{"version": 2, "files": {"photo:x": 3}}'):
        cache.write_text(broken)
        assert look(scene, cache=cache) == plain
    (tmp_path / "file").write_text("")
    assert look(scene, cache=tmp_path / "file" / "cache.json") == plain


def test_cached_scans_open_no_photograph(scene, tmp_path, monkeypatch):
    look(scene, cache=tmp_path / "cache.json")
    for module in ("companion_files", "photo_folder"):
        name = f"pipeline.plan.{module}.read_facts"
        monkeypatch.setattr(name, lambda path: pytest.fail(f"{path}"))
    look(scene, cache=tmp_path / "cache.json")


# --- bad input ----------------------------------------------------------------------------


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
