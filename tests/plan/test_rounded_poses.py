"""The same scene in another unit or at another place: the same bits in the scene's world, and the
given positions in exports."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given as wild
from hypothesis import strategies as st

from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import quat_to_rotation
from pipeline.io.colmap import read_model, write_model
from pipeline.plan.given_poses import GivenModel
from pipeline.scene.normalization import IDENTITY, Normalization
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from pipeline.scene.unrounded import Rounding, Unrounded

SHIFTED = Normalization(1.0, np.array([1e6, 1e6, 1e6]))
VARIANTS = {"shifted": SHIFTED, "km": Normalization(1e3), "mm": Normalization(1e-3)}


def some_model(seed: int = 0, cameras: int = 20, points: int = 200) -> Reconstruction:
    rng = np.random.default_rng(seed)
    images = {
        i: PosedImage(f"{i}.png", 1, quat_to_rotation(rng.normal(size=4)), 3 * rng.normal(size=3))
        for i in range(1, cameras + 1)
    }
    cloud = Points(
        2 * rng.normal(size=(points, 3)),
        np.zeros((points, 3), np.uint8),
        np.zeros(points),
        np.zeros(points + 1, np.int64),
        np.zeros(0, np.int64),
        np.zeros((0, 2)),
    )
    return Reconstruction({1: Camera("PINHOLE", 8, 6, np.array([8.0, 8, 4, 3]))}, images, cloud)


def load(model: Reconstruction, folder: Path) -> GivenModel:
    """The given model after it was written to COLMAP's files and read again, as a user's is."""
    write_model(folder / "sparse", model)
    return GivenModel.of(read_model(folder / "sparse"), folder)


@pytest.mark.parametrize("variant", VARIANTS)
def test_unit_and_origin_change_no_bit_of_the_scene(tmp_path, variant):
    """The shift has rounding errors of 1e-9 and 6e-11, and the files' quaternions are computed from
    matrices again; the values are rounded far above both."""
    there, model = VARIANTS[variant], some_model()
    original = load(model, tmp_path / "original")
    other = load(there.model_to_given(model), tmp_path / "other")
    assert other.normalization.scale == pytest.approx(there.scale, rel=1e-15)
    np.testing.assert_allclose(other.normalization.origin, there.origin, atol=1e-9)
    for found, folder in ((original, "original"), (other, "other")):
        found.write(tmp_path / folder / "inspect")
    files = [tmp_path / folder / "inspect" / "sparse" / "0" for folder in ("original", "other")]
    for name in ("images.bin", "points3D.bin"):
        assert (files[0] / name).read_bytes() == (files[1] / name).read_bytes(), name


@pytest.mark.parametrize("there", [IDENTITY, *VARIANTS.values()])
def test_exports_have_the_given_positions(tmp_path, there):
    model = there.model_to_given(some_model())
    load(model, tmp_path).write(tmp_path / "inspect")
    scene = read_model(tmp_path / "inspect" / "sparse" / "0")
    frame = GivenModel.of(model, tmp_path).normalization
    back = Unrounded.read(tmp_path / "inspect").model_to_given(scene, frame)
    length = np.abs(model.points.xyz).max()
    assert (back.points.xyz == model.points.xyz).all()
    for number, image in model.images.items():
        np.testing.assert_allclose(back.images[number].rotation, image.rotation, atol=1e-15)
        off = np.abs(back.images[number].translation - image.translation).max()
        assert off <= 2e-15 * length
        assert back.images[number].name == image.name


def test_refined_cameras_and_points_are_exported_where_they_are():
    model = some_model()
    given = GivenModel.of(model, Path("poses"))
    image = given.model.images[3]
    moved = replace(image, translation=image.translation + 1e-8)
    images = {**given.model.images, 3: moved}
    points = replace(given.model.points, xyz=given.model.points.xyz.copy())
    points.xyz[7] += 1e-8
    refined = Reconstruction(model.cameras, images, points)
    back = given.unrounded.model_to_given(refined, IDENTITY)
    assert (back.images[3].translation == moved.translation).all()
    assert (back.points.xyz[7] == points.xyz[7]).all()
    rest = np.arange(len(points)) != 7
    assert (back.points.xyz[rest] == model.points.xyz[rest]).all()
    fewer = given.unrounded.model_to_given(replace(refined, points=Points.empty()), IDENTITY)
    assert len(fewer.points) == 0


def test_views_of_one_place_are_exported_with_their_own_rotations():
    """Photographs from a tripod, and a view that was cut out of one of them."""
    model = some_model(cameras=3)
    images = {
        i: replace(image, translation=-image.rotation @ np.array([0.1, 0.2, 0.3]))
        for i, image in model.images.items()
    }
    given = GivenModel.of(replace(model, images=images), Path("poses"))
    turn = quat_to_rotation(np.array([0.5, 0.5, 0.5, 0.5]))
    whole = given.model.images[2]
    part = PosedImage("part", 1, turn @ whole.rotation, turn @ whole.translation)
    scene = replace(given.model, images={**given.model.images, 4: part})
    back = given.unrounded.model_to_given(scene, IDENTITY)
    for number, image in images.items():
        assert (back.images[number].rotation == image.rotation).all()
        assert (back.images[number].translation == image.translation).all()
    assert (back.images[4].rotation == part.rotation).all()
    np.testing.assert_allclose(back.images[4].centre, images[2].centre, atol=1e-15)


@wild(st.floats(1e-9, 1e9), st.integers(0, 9))
def test_rounding_moves_cameras_by_less_than_float32_resolves(size, seed):
    model = Normalization(1 / size).model_to_given(some_model(seed, cameras=3, points=5))
    rounding = Rounding.of_size(size)
    rounded = rounding.model(model)
    assert np.abs(rounded.points.xyz - model.points.xyz).max() <= 2.0**-18 * size
    for number, image in rounded.images.items():
        given = model.images[number]
        assert np.abs(image.centre - given.centre).max() <= 1.01 * 2.0**-23 * size
        assert np.abs(image.rotation - given.rotation).max() <= 1e-11
    again = rounding.model(rounded)
    assert (again.points.xyz == rounded.points.xyz).all()
    for number, image in again.images.items():
        assert (image.rotation == rounded.images[number].rotation).all()
        assert (image.translation == rounded.images[number].translation).all()


def test_cameras_in_one_place_without_points_keep_their_bits():
    image = PosedImage("a.png", 1, np.eye(3), np.array([0.1, 0.2, 0.3]))
    model = Reconstruction(some_model().cameras, {1: image})
    given = GivenModel.of(model, Path("poses"))
    assert (given.model.images[1].translation == image.translation).all()
    assert given.unrounded.model_to_given(given.model, IDENTITY) is given.model
