"""Facts about photographs that a scan reads from their headers: EXIF, bits, order, RAW."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.plan.scan import Scan
from tests.pictures import photos, picture
from tests.plan.test_scan import look, names, write_dng, write_sparse

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
