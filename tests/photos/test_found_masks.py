"""Masks of undistorted views are those of the photographs after the way back through the lens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.config.schema import Undistort, Views
from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import read_model
from pipeline.photos.found_masks import PosedPhotos, enlarged, write_found, write_photo_masks
from pipeline.photos.load import load_mask
from pipeline.photos.undistort import undistort
from pipeline.scene.manifest import Manifest
from tests.photos.test_undistort import SIZE, long_lens, photo, scene


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def undistorted(
    folder: Path, camera: Camera, mask: np.ndarray
) -> tuple[PosedPhotos, PosedPhotos, dict[str, np.ndarray]]:
    """The photographs and views of a scene, and ``mask`` of the photograph in each view: true for
    what is used."""
    height, width = mask.shape
    Image.fromarray(np.full((height, width, 3), 90, np.uint8)).save(folder / "a.jpg")
    Image.fromarray(mask.astype(np.uint8) * 255).save(folder / "m.png")
    manifest, model = scene(camera, photo(folder / "a.jpg", width, height))
    masked, _ = scene(camera, photo(folder / "a.jpg", width, height, mask=str(folder / "m.png")))
    out = folder / "undistort"
    report = undistort(masked, model, Undistort(), Views(), out, threads=1)
    used = {view.name: load_mask(str(view.mask)) for view in report.manifest.photos if view.mask}
    views = PosedPhotos(report.manifest, read_model(out / "sparse" / "0"))
    return PosedPhotos(manifest, model), views, used


@pytest.mark.parametrize("distortion", ["simple_radial", "opencv", "opencv_fisheye"])
def test_a_mask_comes_back_through_the_lens(tmp_path: Path, distortion: str) -> None:
    truth = np.ones(SIZE[::-1], bool)
    truth[30:95, 60:110] = False
    photos, views, used = undistorted(tmp_path, long_lens(distortion), truth)
    write_found(tmp_path / "found", {name: ~mask for name, mask in used.items()})
    write_photo_masks(tmp_path / "masks", tmp_path / "found", views, photos)
    found = load_mask(str(tmp_path / "masks" / "a.png"))
    assert found.shape == truth.shape and overlap(~found, ~truth) > 0.95


def test_the_views_of_a_panorama_make_one_mask(tmp_path: Path) -> None:
    truth = np.ones((200, 400), bool)
    truth[60:140, 30:230] = False  # Across two faces.
    camera = Camera("EQUIRECTANGULAR", 400, 200, np.array([400.0, 200.0]))
    photos, views, used = undistorted(tmp_path, camera, truth)
    assert len(views.manifest.photos) == 6
    write_found(tmp_path / "found", {name: ~mask for name, mask in used.items()})
    write_photo_masks(tmp_path / "masks", tmp_path / "found", views, photos)
    found = load_mask(str(tmp_path / "masks" / "a.png"))
    assert found.shape == truth.shape and overlap(~found, ~truth) > 0.95


def test_masks_of_the_user_are_kept(tmp_path: Path) -> None:
    width, height = SIZE
    camera = Camera("PINHOLE", width, height, np.array([100.0, 100, width / 2, height / 2]))
    own = np.ones((height, width), bool)
    own[:20] = False
    Image.fromarray(own.astype(np.uint8) * 255).save(tmp_path / "own.png")
    names = ["a.jpg", "b.jpg", "c.jpg"]
    for name in names:
        Image.new("RGB", SIZE).save(tmp_path / name)
    masks = {"a.jpg": {"mask": str(tmp_path / "own.png")}, "b.jpg": {}, "c.jpg": {}}
    manifest, model = scene(camera, *(photo(tmp_path / n, *SIZE, **masks[n]) for n in names))
    both = PosedPhotos(Manifest(scene="s", photos=manifest.photos), model)
    person = np.zeros((height // 2, width // 2), bool)
    person[20:40, 30:40] = True
    write_found(tmp_path / "found", {"b.jpg": person})
    write_photo_masks(tmp_path / "masks", tmp_path / "found", both, both)
    assert sorted(path.name for path in (tmp_path / "masks").iterdir()) == ["a.png", "b.png"]
    np.testing.assert_array_equal(load_mask(str(tmp_path / "masks" / "a.png")), own)
    found = load_mask(str(tmp_path / "masks" / "b.png"))
    np.testing.assert_array_equal(~found, enlarged(person, width, height))


def test_nothing_is_written_if_nothing_was_found(tmp_path: Path) -> None:
    camera = Camera("PINHOLE", *SIZE, np.array([100.0, 100, 80, 60]))
    Image.new("RGB", SIZE).save(tmp_path / "a.jpg")
    both = PosedPhotos(*scene(camera, photo(tmp_path / "a.jpg", *SIZE)))
    write_found(tmp_path / "found", {})
    write_photo_masks(tmp_path / "masks", tmp_path / "found", both, both)
    assert not (tmp_path / "masks").exists() and not (tmp_path / "found").exists()
