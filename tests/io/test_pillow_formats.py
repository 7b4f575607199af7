"""HEIC and AVIF images are found, described and decoded like JPEGs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.config.schema import Config
from pipeline.io import pillow_formats
from pipeline.photos.load import load_rgba
from pipeline.photos.verify import verify_photos
from pipeline.plan.scan import scan
from pipeline.runtime.errors import UserError
from pipeline.sfm.sift import DetectionImage
from tests.tools import need_data

HEIC = pytest.param(
    ".heic",
    marks=pytest.mark.skipif(
        not pillow_formats.heif_installed(),
        reason="not run: pillow-heif missing (make test-packages)",
    ),
)
both = pytest.mark.parametrize("suffix", [".avif", HEIC])


def write(path: Path, orientation: int = 1, blue: int = 255) -> np.ndarray:
    """Write a smooth image with EXIF data; returns its pixels (60, 80, 3)."""
    suffix = path.suffix.lower()
    pillow_formats.register(suffix)
    y, x = np.mgrid[:60, :80]
    rgb = np.stack([3 * x, 4 * y, blue - 2 * x], 2).astype(np.uint8)
    exif = Image.Exif()
    exif[0x0110], exif[0x0112] = "PHONE 7", orientation
    exif.get_ifd(0x8769)[0xA405] = 26
    Image.fromarray(rgb).save(
        path, format={".avif": "AVIF", ".heic": "HEIF"}[suffix], quality=95, exif=exif.tobytes()
    )
    return rgb


@both
def test_photographs_are_found_described_and_decoded(suffix: str, tmp_path: Path) -> None:
    names = [f"a{suffix}", f"b{suffix.upper()}"]
    written = [write(tmp_path / names[0]), write(tmp_path / names[1], blue=80)]
    found = scan(tmp_path, "s", Config(), cache=None)
    assert [photo.name for photo in found.photos] == names
    photo = found.photos[0]
    assert (photo.width, photo.height, photo.alpha, photo.bits) == (80, 60, False, 8)
    assert "PHONE 7" in photo.camera_group and photo.focal_px is not None
    assert verify_photos(found.manifest, threads=1)[1] == []
    rgb, alpha = load_rgba(photo.path)
    assert alpha is None and np.abs(rgb.astype(int) - written[0]).mean() < 3
    assert np.array_equal(DetectionImage(photo, 1000).rgb, rgb)


@both
def test_size_and_pixels_agree_for_rotated_images(suffix: str, tmp_path: Path) -> None:
    write(tmp_path / f"a{suffix}", orientation=6)
    write(tmp_path / f"b{suffix}", orientation=6)
    photo = scan(tmp_path, "s", Config(), cache=None).photos[0]
    assert load_rgba(photo.path)[0].shape == (photo.height, photo.width, 3)
    assert DetectionImage(photo, 1000).rgb.shape == (photo.height, photo.width, 3)


@pytest.mark.skipif(not pillow_formats.heif_installed(), reason="not run: pillow-heif missing")
def test_a_file_from_a_phone_is_read() -> None:
    path = need_data("raw/heic/iphone_7.heic")
    one = Config.model_validate({"inspect": {"min_images": 1}})
    photo = scan(path.parent, "s", one, cache=None).photos[0]
    assert "iPhone 7" in photo.camera_group and photo.gps is not None
    assert load_rgba(photo.path)[0].shape == (photo.height, photo.width, 3)


@both
def test_a_damaged_file_is_a_user_error(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    write(path)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(UserError, match=path.name):
        load_rgba(path)
