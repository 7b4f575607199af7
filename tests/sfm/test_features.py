"""Features: positions, masks, image formats and the cache."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.config import settled
from pipeline.io.recorded import digest_of
from pipeline.runtime.errors import UserError
from pipeline.sfm.features import extract_features
from pipeline.sfm.keypoints import Keypoints, keypoint_file
from tests.sfm import corner, jobs

CONFIG = settled.Features(max_features=500)


def extract(folder: Path, photos, config=CONFIG, threads: int = 2):
    """Keypoints by name, and the report."""
    manifest = corner.manifest(photos)
    out = folder / "features"
    report = extract_features(manifest, config, out, cache=folder / "cache", threads=threads)
    return {p.name: Keypoints.read(keypoint_file(out, p.name)) for p in photos}, report


@pytest.fixture
def pixels() -> np.ndarray:
    return corner.picture(*corner.poses(3)[1], seed=1)


def saved(folder: Path, file: str, pixels: np.ndarray, **facts):
    folder.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(folder / file), pixels)
    return corner.photo(folder / file, **facts)


def masked(mask: Path) -> dict[str, str]:
    """Fields of ``Photo`` for a mask."""
    return {"mask": str(mask), "mask_digest": digest_of(mask)}


def test_the_strongest_keypoints_are_selected_and_sorted_by_scale(tmp_path, pixels):
    photo = saved(tmp_path, "a.png", pixels)
    found, report = extract(tmp_path, [photo])
    keypoints = found["a.png"]
    assert len(keypoints) == report.counters.counts["a.png"] == CONFIG.max_features
    assert (np.diff(keypoints.scale) <= 0).all()
    assert keypoints.descriptors.shape == (500, 128)
    norms = np.linalg.norm(keypoints.descriptors.astype(float), axis=1)
    np.testing.assert_allclose(norms, 512, rtol=0.02)
    at = np.floor(keypoints.xy).astype(int)
    assert (keypoints.rgb == pixels[at[:, 1], at[:, 0], ::-1]).all()


def test_a_blob_is_detected_at_its_centre(tmp_path):
    # A Gaussian blob about (100.5, 80.5) in COLMAP's pixels: the centre of pixel (100, 80).
    y, x = np.mgrid[0:200, 0:240]
    blob = 200 * np.exp(-((x - 100) ** 2 + (y - 80) ** 2) / (2 * 6.0**2))
    photo = saved(tmp_path, "a.png", blob.astype(np.uint8))
    for long_side in (1600, 120):  # at full and at half resolution
        config = settled.Features(max_long_side_px=long_side)
        keypoints = extract(tmp_path, [photo], config)[0]["a.png"]
        nearest = np.linalg.norm(keypoints.xy - [100.5, 80.5], axis=1).min()
        assert nearest < 0.1, long_side
        assert keypoints.scale[0] == pytest.approx(6.0, rel=0.2)


def test_colmaps_extractor_agrees_on_positions_and_descriptors(tmp_path, pixels):
    photo = saved(tmp_path, "a.png", pixels)
    config = settled.Features(max_features=100_000)
    ours = extract(tmp_path, [photo], config)[0]["a.png"]
    colmap = settled.Features(backend="colmap", max_features=100_000)
    theirs = extract(tmp_path, [photo], colmap)[0]["a.png"]
    distance = np.linalg.norm(ours.xy[:, None] - theirs.xy[None], axis=-1)
    close = distance.min(1) < 1.0
    assert close.mean() > 0.5
    offset = (ours.xy - theirs.xy[distance.argmin(1)])[close]
    # Different conventions for pixel centres would differ by half a pixel.
    assert np.abs(np.median(offset, axis=0)).max() < 0.05
    a = ours.descriptors[close].astype(float)
    b = theirs.descriptors[distance.argmin(1)][close].astype(float)
    cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    assert np.median(cosine) > 0.9


def test_masked_pixels_have_no_features(tmp_path, pixels):
    mask = np.zeros(pixels.shape[:2], np.uint8)
    mask[:, :150] = 1  # non-zero is enough
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    photo = saved(tmp_path, "a.png", pixels, **masked(tmp_path / "mask.png"))
    keypoints = extract(tmp_path, [photo])[0]["a.png"]
    assert (keypoints.xy[:, 0] <= 151).all()
    # The strongest are selected among the unmasked ones.
    assert len(keypoints) == CONFIG.max_features


def test_transparent_pixels_have_no_features(tmp_path, pixels):
    alpha = np.zeros(pixels.shape[:2], np.uint8)
    alpha[:, 250:] = 255
    photo = saved(tmp_path, "a.png", np.dstack([pixels, alpha]), alpha=True)
    keypoints = extract(tmp_path, [photo])[0]["a.png"]
    assert len(keypoints) > 50 and (keypoints.xy[:, 0] >= 249).all()


def test_sixteen_bits_and_grey_and_eight_bits_agree(tmp_path, pixels):
    grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    photos = [
        saved(tmp_path, "grey8.png", grey),
        saved(tmp_path, "grey16.png", grey.astype(np.uint16) * 257, bits=16),
        saved(tmp_path, "colour16.png", np.dstack([grey] * 3).astype(np.uint16) * 257, bits=16),
    ]
    found, _ = extract(tmp_path, photos)
    for name in ("grey16.png", "colour16.png"):
        np.testing.assert_array_equal(found[name].descriptors, found["grey8.png"].descriptors)
        np.testing.assert_array_equal(found[name].xy, found["grey8.png"].xy)


def test_exif_orientation_is_not_applied(tmp_path, pixels):
    exif = Image.Exif()
    exif[274] = 6
    picture = Image.fromarray(pixels[..., ::-1])
    picture.save(tmp_path / "plain.jpg", quality=95)
    picture.save(tmp_path / "turned.jpg", quality=95, exif=exif)
    photos = [corner.photo(tmp_path / "plain.jpg"), corner.photo(tmp_path / "turned.jpg")]
    found, _ = extract(tmp_path, photos)
    np.testing.assert_array_equal(found["plain.jpg"].xy, found["turned.jpg"].xy)


def test_adding_a_photograph_extracts_one(tmp_path):
    photos, _ = corner.write_scene(tmp_path / "photos", 3)
    _, first = extract(tmp_path, photos[:2])
    _, second = extract(tmp_path, photos)
    assert (first.num_cached, second.num_cached) == (0, 2)


def test_copies_of_a_photograph_are_extracted_once(tmp_path, pixels):
    photos = [saved(tmp_path, f"{i}.png", pixels) for i in range(8)]
    found, report = extract(tmp_path, photos, threads=4)
    assert len(found) == 8 and report.num_cached == 0
    assert len(list((tmp_path / "cache").iterdir())) == 1


def test_changed_photographs_masks_and_options_are_extracted_again(tmp_path, pixels):
    mask = tmp_path / "mask.png"
    cv2.imwrite(str(mask), np.ones(pixels.shape[:2], np.uint8))
    photo = saved(tmp_path, "a.png", pixels, **masked(mask))
    assert extract(tmp_path, [photo])[1].num_cached == 0
    assert extract(tmp_path, [photo])[1].num_cached == 1
    assert extract(tmp_path, [photo], settled.Features(max_features=400))[1].num_cached == 0
    cv2.imwrite(str(mask), np.eye(*pixels.shape[:2], dtype=np.uint8))
    photo = photo.model_copy(update=masked(mask))
    assert extract(tmp_path, [photo])[1].num_cached == 0


@pytest.mark.parametrize("backend", ["opencv", "colmap"])
@pytest.mark.parametrize("changed", ["a.png", "mask.png"])
def test_a_file_changed_since_inspect_is_an_error_and_nothing_is_cached(
    tmp_path, pixels, changed, backend
):
    cv2.imwrite(str(tmp_path / "mask.png"), np.ones(pixels.shape[:2], np.uint8))
    photo = saved(tmp_path, "a.png", pixels, **masked(tmp_path / "mask.png"))
    cv2.imwrite(str(tmp_path / changed), np.roll(pixels, 40, axis=1))  # of the same size
    with pytest.raises(UserError, match=f"{changed}: has changed since the scene was inspected"):
        extract(tmp_path, [photo], settled.Features(backend=backend))
    assert not list((tmp_path / "cache").iterdir())


def test_the_cache_distinguishes_options_and_is_pruned(tmp_path, pixels):
    photo = saved(tmp_path, "a.png", pixels)
    for limit, cached, stored in ((400, 0, 1), (300, 0, 2), (400, 1, 2), (200, 0, 1)):
        _, report = extract(tmp_path, [photo], settled.Features(max_features=limit))
        assert (report.num_cached, len(list((tmp_path / "cache").iterdir()))) == (cached, stored)


def test_files_do_not_depend_on_threads_or_cache(tmp_path):
    photos, _ = corner.write_scene(tmp_path / "photos", 3)
    for threads in (1, 2):
        extract(tmp_path / str(threads), photos, threads=threads)
    extract(tmp_path / "2", photos, threads=2)
    first, second = (jobs.digests(tmp_path / t / "features") for t in "12")
    assert first == second and len(first) == 3


def test_similar_names_in_different_folders_have_distinct_files(tmp_path, pixels):
    photos = [
        saved(tmp_path / "x" / "y", "a.png", pixels, name="x/y/a.png"),
        saved(tmp_path / "z", "a.png", pixels[:, ::-1], name="x_y_a.png"),
        saved(tmp_path / "w", "a.png", pixels[::-1], name="x%2Fy%2Fa.png"),
    ]
    extract(tmp_path, photos)
    assert len(list((tmp_path / "features").iterdir())) == 3


def test_a_photograph_without_features_is_a_warning(tmp_path):
    photo = saved(tmp_path, "wall.png", np.full((200, 300), 128, np.uint8))
    found, report = extract(tmp_path, [photo])
    assert len(found["wall.png"]) == 0
    assert report.warnings == ["wall.png: only 0 features"]


def test_unreadable_photographs_are_an_error(tmp_path, pixels):
    photo = saved(tmp_path, "a.png", pixels)
    (tmp_path / "a.png").write_text("not a picture")
    photo = photo.model_copy(update={"digest": digest_of(tmp_path / "a.png")})
    with pytest.raises(UserError, match=r"a\.png: not a readable image"):
        extract(tmp_path, [photo])
    (tmp_path / "a.png").unlink()
    with pytest.raises(UserError, match=r"a\.png: cannot be read"):
        extract(tmp_path, [photo])
