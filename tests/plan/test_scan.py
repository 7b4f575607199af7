"""Scanning a scene folder: supported layouts, EXIF data, fingerprints, errors."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline.config.schema import Config
from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import read_model, write_model
from pipeline.plan.given_poses import GivenModel, load_given
from pipeline.plan.protocols import PUBLISHED_SCENES, benchmark_scene
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
def test_scenes_of_mip_nerf_360_have_the_size_that_papers_use(tmp_path, scene, chosen, monkeypatch):
    folder = tmp_path / scene
    title = f"{benchmark_scene(scene)} of Mip-NeRF 360"
    small = dataclasses.replace(PUBLISHED_SCENES[title], photographs=(2,))
    monkeypatch.setitem(PUBLISHED_SCENES, title, small)
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
