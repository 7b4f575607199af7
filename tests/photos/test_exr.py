"""EXR files: developed to sRGB with one exposure, straight alpha; unusual and damaged ones."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from pipeline.config.schema import Config, Decode
from pipeline.photos.develop import develop
from pipeline.photos.load import load_rgb, load_rgba
from pipeline.photos.verify import verify_photos
from pipeline.plan.scan import scan
from pipeline.runtime.errors import UserError
from tests.pictures import photos

HEADER = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def write(path: Path, primaries: tuple[float, ...] = (), **channels: np.ndarray) -> Path:
    header = dict(HEADER) | ({"chromaticities": primaries} if primaries else {})
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
    return path


def ramp(width: int = 40, height: int = 30) -> np.ndarray:
    x = np.linspace(-0.1, 1.6, width, dtype=np.float32)
    return np.stack([np.tile(x, (height, 1)), np.full((height, width), 0.18, np.float32)], 2)


def test_linear_light_becomes_srgb_and_one_is_white(tmp_path: Path) -> None:
    red, green = (np.ascontiguousarray(p) for p in np.moveaxis(ramp(), 2, 0))
    write(tmp_path / "a.exr", R=red, G=green, B=green)
    write(tmp_path / "b.exr", R=red / 2, G=green, B=green)
    found = scan(tmp_path, "s", Config(), cache=None)
    assert found.num_linear == 2 and found.sizes == [(40, 30)]
    assert verify_photos(found.manifest, threads=2)[1] == []
    first, second = develop(found.manifest, Decode(), tmp_path / "out", threads=2).manifest.photos
    assert (first.name, first.bits, first.linear, first.alpha) == ("a.png", 8, False, False)
    rgb = load_rgb(first.path)
    assert rgb[0, 0, 0] == 0 and np.all(rgb[0, red[0] >= 1, 0] == 255)
    assert rgb[0, 0, 1] == 118  # 18 % grey in sRGB
    # The exposure does not depend on the image.
    assert np.array_equal(rgb[..., 1], load_rgb(second.path)[..., 1])
    linear = develop(found.manifest, Decode(linear=True), tmp_path / "linear", threads=1)
    deep = load_rgb(linear.manifest.photos[0].path)
    assert deep.dtype == np.uint16 and deep[0, 0, 1] == round(0.18 * 65535)


def test_other_primaries_are_converted_to_those_of_srgb(tmp_path: Path) -> None:
    """Display P3's, ACES AP0's (which differ in white as well), sRGB's own, and impossible ones."""
    p3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
    aces = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
    srgb = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
    plane = np.full((30, 40), 0.2, np.float32)
    # sRGB (0.4, 0.2, 0.1) in linear Display P3 (CSS Color 4, section 10.2).
    colour = {"R": 0.3645, "G": 0.2066, "B": 0.1124}
    planes = {name: np.full((30, 40), value, np.float32) for name, value in colour.items()}
    write(tmp_path / "a.exr", p3, **planes)
    write(tmp_path / "b.exr", aces, R=plane, G=plane, B=plane)
    write(tmp_path / "c.exr", srgb, R=plane, G=plane, B=plane)
    write(tmp_path / "d.exr", (0.1,) * 8, R=plane, G=plane, B=plane)
    found = scan(tmp_path, "s", Config(), cache=None)
    assert [bool(photo.colours) for photo in found.photos] == [True, True, False, False]
    (fault,) = [text for text in found.manifest.warnings if "used as sRGB" in text]
    assert "impossible chromaticities" in fault and "d.exr" in fault
    made = develop(found.manifest, Decode(linear=True), tmp_path / "out", threads=1).manifest
    a, b, c, d = (load_rgb(photo.path)[0, 0] / 65535 for photo in made.photos)
    np.testing.assert_allclose(a, [0.4, 0.2, 0.1], atol=1e-3)
    # Grey stays grey.
    np.testing.assert_allclose(b, 0.2, atol=1e-3)
    np.testing.assert_allclose(c, 0.2, atol=1e-5)
    np.testing.assert_allclose(d, 0.2, atol=1e-5)


def test_colours_are_divided_by_alpha(tmp_path: Path) -> None:
    half = np.full((30, 40), 0.5, np.float16)
    alpha = half.copy()
    alpha[:, :10] = 0
    for name in "ab":
        write(tmp_path / f"{name}.exr", R=half * half, G=half * half, B=half * half, A=alpha)
    manifest = scan(tmp_path, "s", Config(), cache=None).manifest
    photo = develop(manifest, Decode(), tmp_path / "out", threads=1).manifest.photos[0]
    rgb, opacity = load_rgba(photo.path)
    assert opacity is not None and set(np.unique(opacity)) == {0, 128}
    assert np.all(rgb[:, 10:] == 188) and np.all(rgb[:, :10] == 0)


def test_other_files_are_left_out_with_the_reason(tmp_path: Path) -> None:
    photos(tmp_path, 2)
    plane = np.zeros((8, 8), np.float32)
    write(tmp_path / "depth.exr", Z=plane)
    write(tmp_path / "cut.exr", R=plane, G=plane, B=plane)
    data = (tmp_path / "cut.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(data[:-20])
    (tmp_path / "text.exr").write_text("no image")
    small, wide = (struct.pack("<4i", 0, 0, side, side) for side in (7, 99_999))
    (tmp_path / "wide.exr").write_bytes(data.replace(small, wide))
    found = scan(tmp_path, "s", Config(), cache=None)
    manifest, _ = verify_photos(found.manifest, threads=1)
    assert [photo.name for photo in manifest.photos] == ["p00.jpg", "p01.jpg"]
    text = "\n".join(manifest.warnings)
    assert "depth.exr: left out: cannot be read as a photograph: expected channels R, G, B" in text
    assert "wide.exr: left out: cannot be read as a photograph: impossible size" in text
    assert "text.exr: left out" in text and "cut.exr: left out" in text


def test_nothing_readable_is_one_error(tmp_path: Path) -> None:
    plane = np.zeros((8, 8), np.float32)
    for name in ("a", "b"):
        write(tmp_path / f"{name}.exr", R=plane, G=plane, B=plane)
    manifest = scan(tmp_path, "s", Config(), cache=None).manifest
    for photo in manifest.photos:
        Path(photo.path).write_bytes(Path(photo.path).read_bytes()[:-20])
    with pytest.raises(UserError):
        develop(manifest, Decode(), tmp_path / "out", threads=1)
