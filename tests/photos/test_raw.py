"""RAW files: accurate colours, the same settings for all, damaged files are left out."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.config.schema import Decode
from pipeline.demo.cameras import orbit
from pipeline.demo.render import rays, render
from pipeline.demo.scene import OBJECTS
from pipeline.demo.sensor import expose, srgb, to_bytes, write_dng
from pipeline.geometry.cameras import Camera
from pipeline.io.recorded import digest_of
from pipeline.photos.develop import develop
from pipeline.photos.load import load_rgb
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest, Photo
from tests.tools import need_data

TAKEN = "2026:01:01 12:00:00"


def manifest(paths: list[Path], width: int, height: int) -> Manifest:
    photos = [
        Photo(
            name=path.name,
            path=str(path),
            width=width,
            height=height,
            digest=digest_of(path),
            linear=True,
            bits=16,
            focal_px=100.0,
            camera_group="one",
            orientation=6,
        )
        for path in sorted(paths)
    ]
    return Manifest(scene="raw", photos=tuple(photos))


def psnr(a: np.ndarray, b: np.ndarray, peak: float) -> float:
    error = np.mean((a.astype(np.float64) - b.astype(np.float64)) ** 2)
    return float(10 * np.log10(peak**2 / error))


@pytest.fixture(scope="module")
def light() -> np.ndarray:
    """A view of the demo scene in linear light, blurred to what a Bayer mosaic can resolve."""
    camera = Camera("PINHOLE", 200, 150, np.array([480.0, 480.0, 100.0, 75.0]))
    sharp = render(orbit(["a"] * 8, 0)[0], camera, rays(camera), OBJECTS).light
    return np.asarray(cv2.GaussianBlur(sharp, (0, 0), 0.8))


def test_a_developed_dng_equals_its_source(tmp_path: Path, light: np.ndarray) -> None:
    write_dng(tmp_path / "a.dng", expose(light, 0.0, (0, 0)), TAKEN)
    source = manifest([tmp_path / "a.dng"], 200, 150)
    report = develop(source, Decode(), tmp_path / "display", threads=1)
    inner = np.s_[4:-4, 4:-4]
    display = load_rgb(report.manifest.photos[0].path)
    assert psnr(display[inner], to_bytes(srgb(light))[inner], 255) >= 40
    linear = develop(source, Decode(linear=True), tmp_path / "linear", threads=1)
    deep = load_rgb(linear.manifest.photos[0].path)
    assert deep.dtype == np.uint16 and linear.manifest.photos[0].bits == 16
    assert psnr(deep[inner], np.clip(light, 0, 1)[inner] * 65535, 65535) >= 40


def test_development_does_not_depend_on_other_image_content(
    tmp_path: Path,
) -> None:
    dark = np.full((64, 96, 3), 0.05)
    bright = dark.copy()
    bright[:, 48:] = 0.9  # LibRaw's automatic exposure would darken this image
    for name, light in (("dark", dark), ("bright", bright)):
        write_dng(tmp_path / f"{name}.dng", expose(light, 0.0, (0, 0)), TAKEN)
    both = manifest([tmp_path / "bright.dng", tmp_path / "dark.dng"], 96, 64)
    report = develop(both, Decode(), tmp_path / "out", threads=2)
    first, second = (load_rgb(photo.path) for photo in report.manifest.photos)
    assert np.array_equal(first[:, :40], second[:, :40])
    assert np.all(np.abs(second.astype(int) - to_bytes(srgb(dark))) <= 1)


def test_manifest_of_developed_files(tmp_path: Path, light: np.ndarray) -> None:
    for name in ("a.dng", "b.dng"):
        write_dng(tmp_path / name, expose(light[:64, :96], 0.0, (0, 0)), TAKEN)
    source = manifest([tmp_path / "a.dng", tmp_path / "b.dng"], 96, 64)
    report = develop(source, Decode(half_size=True), tmp_path / "out", threads=2)
    assert Manifest.read(tmp_path / "out" / "images.json") == report.manifest
    for photo, name in zip(report.manifest.photos, ("a.png", "b.png"), strict=True):
        assert (photo.name, photo.width, photo.height) == (name, 48, 32)
        assert load_rgb(photo.path).shape == (32, 48, 3)
        assert photo.focal_px == 50.0 and not photo.linear and photo.camera_group == "one"
        assert photo.orientation == 6  # recorded, not applied
    (tmp_path / "out").rename(tmp_path / "moved")
    moved = Manifest.read(tmp_path / "moved" / "images.json")
    assert load_rgb(moved.photos[0].path).shape == (32, 48, 3)


def test_no_orientation_in_a_raw_file_turns_its_pixels(tmp_path: Path, light: np.ndarray) -> None:
    """LibRaw turns them by default; the poses are those of the pixels as stored."""
    pixels = []
    for orientation in range(1, 9):
        file = tmp_path / f"{orientation}.dng"
        write_dng(file, expose(light[:64, :96], 0.0, (0, 0)), TAKEN)
        data = bytearray(file.read_bytes())
        at = data.index(struct.pack("<HHIH", 274, 3, 1, 1))
        data[at + 8] = orientation
        file.write_bytes(data)
        report = develop(manifest([file], 96, 64), Decode(), tmp_path / f"{orientation}", threads=1)
        pixels.append(load_rgb(report.manifest.photos[0].path))
    assert pixels[0].shape == (64, 96, 3)
    assert all(np.array_equal(pixels[0], turned) for turned in pixels)


def test_damaged_raw_files_are_left_out_and_all_damaged_is_an_error(
    tmp_path: Path, light: np.ndarray
) -> None:
    for name in ("a.dng", "b.dng", "c.dng"):
        write_dng(tmp_path / name, expose(light[:64, :96], 0.0, (0, 0)), TAKEN)
    (tmp_path / "b.dng").write_bytes((tmp_path / "b.dng").read_bytes()[:5000])
    (tmp_path / "c.dng").write_text("no RAW file")
    source = manifest([tmp_path / f"{n}.dng" for n in "abc"], 96, 64)
    report = develop(source, Decode(), tmp_path / "out", threads=2)
    assert [photo.name for photo in report.manifest.photos] == ["a.png"]
    assert len(report.warnings) == 2 and report.manifest.warnings == report.warnings
    for name in ("b.dng", "c.dng"):
        assert (
            sum(text.startswith(f"{name}: left out, it cannot be read") for text in report.warnings)
            == 1
        )
    broken = manifest([tmp_path / "b.dng", tmp_path / "c.dng"], 96, 64)
    with pytest.raises(UserError, match="none of the 2 RAW and EXR files"):
        develop(broken, Decode(), tmp_path / "out2", threads=2)


def test_equal_stems_get_distinct_names(tmp_path: Path, light: np.ndarray) -> None:
    for name in ("a.dng", "a.nef"):
        write_dng(tmp_path / name, expose(light[:64, :96], 0.0, (0, 0)), TAKEN)
    source = manifest([tmp_path / "a.dng", tmp_path / "a.nef"], 96, 64)
    report = develop(source, Decode(), tmp_path / "out", threads=1)
    assert [photo.name for photo in report.manifest.photos] == ["a.dng.png", "a.nef.png"]


def test_real_raw_files_of_three_bodies(tmp_path: Path) -> None:
    sizes = {
        "canon_eos_6d_linear_lossy.dng": (1224, 816),
        "canon_eos_kissx4_magiclantern_colorchart.dng": (1734, 1156),
        "kodak_dc50.KDC": (768, 512),
    }
    photos = [manifest([need_data("raw") / name], *size).photos[0] for name, size in sizes.items()]
    source = Manifest(scene="raw", photos=tuple(photos))
    report = develop(source, Decode(demosaic="linear"), tmp_path, threads=2)
    assert not report.warnings
    for photo, size in zip(report.manifest.photos, sizes.values(), strict=True):
        rgb = load_rgb(photo.path)
        assert rgb.shape[1::-1] == size == (photo.width, photo.height)
        assert 10 < rgb.mean() < 200
