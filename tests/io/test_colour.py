"""Colours of every profile become sRGB; sRGB itself is not changed by a bit; what cannot be
converted is said."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageCms

from pipeline.config.schema import Config
from pipeline.io import icc
from pipeline.io.colour import Colours, to_srgb
from pipeline.io.photofile import read_facts
from pipeline.photos.load import load_rgb, load_rgba, read_depth
from pipeline.plan.colours import converted_colours
from pipeline.plan.scan import scan
from tests.io.test_pictures import tiff_bytes

P3 = icc.write_profile("Display P3", icc.DISPLAY_P3, icc.SRGB_CURVE)
ADOBE = icc.write_profile("Adobe RGB (1998)", icc.ADOBE_RGB, (563 / 256,))
PROPHOTO = icc.write_profile(
    "ProPhoto RGB",
    ((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001 + 0.002), (0.3457, 0.3585)),
    (1.8,),
)
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
OURS = icc.write_profile("sRGB", icc.SRGB, icc.SRGB_CURVE)
PROFILES = {"Display P3": P3, "Adobe RGB (1998)": ADOBE, "ProPhoto RGB": PROPHOTO}


def muted(seed: int = 0) -> np.ndarray:
    """(24, 40, 3) smooth colours of sRGB that every other space holds."""
    rng = np.random.default_rng(seed)
    corners = rng.integers(40, 216, (4, 3))
    y, x = np.mgrid[0:1:24j, 0:1:40j][..., None]
    mixed = (1 - y) * ((1 - x) * corners[0] + x * corners[1])
    return np.rint(mixed + y * ((1 - x) * corners[2] + x * corners[3])).astype(np.uint8)


def converted(rgb: np.ndarray, profile: bytes) -> np.ndarray:
    """Values of sRGB colours in the space of a profile, by Pillow."""
    source = ImageCms.createProfile("sRGB")
    target = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    image = ImageCms.profileToProfile(
        Image.fromarray(rgb), source, target, ImageCms.Intent.RELATIVE_COLORIMETRIC
    )
    assert image is not None
    return np.asarray(image)


def with_chunks(path: Path, rgb: np.ndarray, **chunks: bytes) -> Path:
    """A PNG with further chunks before its pixels."""
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, "PNG")
    data = buffer.getvalue()
    more = b"".join(
        struct.pack(">I", len(body))
        + kind.encode()
        + body
        + zlib.crc32(kind.encode() + body).to_bytes(4, "big")
        for kind, body in chunks.items()
    )
    path.write_bytes(data[:33] + more + data[33:])
    return path


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp", ".jpg", ".avif"])
@pytest.mark.parametrize("name", sorted(PROFILES))
def test_embedded_profiles_are_converted(tmp_path: Path, name: str, suffix: str) -> None:
    options = {".webp": {"lossless": True}, ".jpg": {"quality": 98, "subsampling": 0}}
    stored = converted(muted(), PROFILES[name])
    assert np.abs(stored.astype(int) - muted()).max() > 4
    path = tmp_path / f"a{suffix}"
    Image.fromarray(stored).save(path, icc_profile=PROFILES[name], **options.get(suffix, {}))
    assert read_facts(path).colours == name
    tolerance = 3 if suffix in (".png", ".tif", ".webp") else 12
    assert np.abs(load_rgb(path).astype(int) - muted()).max() <= tolerance


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp", ".jpg"])
@pytest.mark.parametrize("profile", [SRGB, OURS], ids=["Pillow's", "ours"])
@pytest.mark.parametrize("mode", ["RGB", "L", "RGBA"])
def test_srgb_profiles_change_no_bit(
    tmp_path: Path, profile: bytes, suffix: str, mode: str
) -> None:
    if mode == "RGBA" and suffix == ".jpg":  # JPEG has no alpha.
        return
    rng = np.random.default_rng(0)
    image = Image.fromarray(rng.integers(0, 256, (24, 40, 3), np.uint8)).convert(mode)
    image.save(tmp_path / f"plain{suffix}")
    image.save(tmp_path / f"tagged{suffix}", icc_profile=profile)
    plain, tagged = (load_rgba(tmp_path / f"{name}{suffix}") for name in ("plain", "tagged"))
    assert np.array_equal(plain[0], tagged[0])
    assert read_facts(tmp_path / f"tagged{suffix}").colours == ""


@pytest.mark.parametrize("name", sorted(PROFILES))
def test_16_bits_are_converted_in_16_bits(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(0)
    deep = rng.integers(0, 65536, (32, 32, 3), np.uint16)
    profile = PROFILES[name]
    data = tiff_bytes(deep, photometric="rgb", iccprofile=profile)
    (tmp_path / "a.tif").write_bytes(data)
    found = load_rgb(tmp_path / "a.tif")
    assert found.dtype == np.uint16 and len(np.unique(found)) > 1500
    reduced = ((deep.astype(np.uint32) + 128) // 257).astype(np.uint8)
    expected = to_srgb(reduced, Colours(profile, name))
    # Values near 0 are steep: their 8 bits are coarse.
    bright = (reduced > 40).all(axis=2)
    difference = np.abs(found / 257 - expected)[bright]
    assert difference.max() < 8 and difference.mean() < 0.6


def test_alpha_and_grey_are_kept(tmp_path: Path) -> None:
    alpha = np.arange(24 * 40, dtype=np.uint16).reshape(24, 40).astype(np.uint8)
    stored = np.dstack([converted(muted(), P3), alpha])
    Image.fromarray(stored).save(tmp_path / "a.png", icc_profile=P3)
    rgb, found = load_rgba(tmp_path / "a.png")
    assert found is not None and np.array_equal(found, alpha)
    assert np.abs(rgb.astype(int) - muted())[alpha > 0].max() <= 3
    # Grey of Display P3 is grey of sRGB: their curves are the same.
    Image.fromarray(stored[..., 0]).save(tmp_path / "grey.png", icc_profile=P3)
    assert np.abs(load_rgb(tmp_path / "grey.png").astype(int) - stored[..., :1]).max() <= 1


def test_png_code_points_and_gamma(tmp_path: Path) -> None:
    stored = converted(muted(), P3)
    path = with_chunks(tmp_path / "cicp.png", stored, cICP=bytes([12, 13, 0, 1]))
    assert read_facts(path).colours == "Display P3"
    assert np.abs(load_rgb(path).astype(int) - muted()).max() <= 3
    for number, chunks in enumerate(
        (
            {"cICP": bytes([1, 13, 0, 1])},
            {"gAMA": struct.pack(">I", 45455)},
            {"sRGB": b"\0", "gAMA": struct.pack(">I", 100000)},
        )
    ):
        path = with_chunks(tmp_path / f"{number}.png", muted(), **chunks)
        assert np.array_equal(load_rgb(path), muted()) and not read_facts(path).colours
    path = with_chunks(tmp_path / "linear.png", muted(), gAMA=struct.pack(">I", 100000))
    assert read_facts(path).colours == "gamma 1"
    assert (load_rgb(path) >= muted()).all()
    path = with_chunks(tmp_path / "hdr.png", muted(), cICP=bytes([9, 16, 0, 1]))
    assert "PQ" in read_facts(path).colours_fault
    assert np.array_equal(load_rgb(path), muted())


@pytest.mark.parametrize(
    ("space", "index", "name"),
    [(1, "R98", ""), (2, None, "Adobe RGB"), (65535, "R03", "Adobe RGB"), (65535, None, "")],
)
def test_exif_names_adobe_rgb(tmp_path: Path, space: int, index: str | None, name: str) -> None:
    exif = Image.Exif()
    ifd = exif.get_ifd(0x8769)
    ifd[0xA001] = space
    if index is not None:
        ifd[0xA005] = {1: index}
    Image.fromarray(muted()).save(tmp_path / "a.jpg", exif=exif, quality=98)
    assert read_facts(tmp_path / "a.jpg").colours == name
    Image.fromarray(muted()).save(tmp_path / "b.jpg", exif=exif, quality=98, icc_profile=SRGB)
    assert read_facts(tmp_path / "b.jpg").colours == ""


def test_avif_code_points(tmp_path: Path) -> None:
    Image.fromarray(muted()).save(tmp_path / "a.avif", quality=95)
    plain = load_rgb(tmp_path / "a.avif")
    data = (tmp_path / "a.avif").read_bytes()
    at = data.index(b"colrnclx")
    (tmp_path / "b.avif").write_bytes(data[: at + 8] + b"\0\x0c" + data[at + 10 :])
    assert read_facts(tmp_path / "a.avif").colours == ""
    assert read_facts(tmp_path / "b.avif").colours == "Display P3"
    expected = to_srgb(np.ascontiguousarray(plain), Colours(P3, ""))
    assert np.abs(load_rgb(tmp_path / "b.avif").astype(int) - expected).max() <= 2


@given(st.binary(max_size=3000), st.integers(0, len(P3)))
@settings(max_examples=60, deadline=None)
def test_damaged_profiles_are_named_and_ignored(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, cut: int
) -> None:
    path = tmp_path_factory.mktemp("x") / "a.png"
    for profile in (data or b"x", P3[: min(cut, 120)] or b"x"):
        Image.fromarray(muted()).save(path, icc_profile=profile)
        assert "profile" in read_facts(path).colours_fault
        assert np.array_equal(load_rgb(path), muted())


def test_a_profile_of_other_channels_is_named(tmp_path: Path) -> None:
    grey = bytearray(P3)
    grey[16:20] = b"CMYK"
    Image.fromarray(muted()).save(tmp_path / "a.png", icc_profile=bytes(grey))
    assert "profile" in read_facts(tmp_path / "a.png").colours_fault
    assert np.array_equal(load_rgb(tmp_path / "a.png"), muted())


def test_depth_maps_are_never_converted(tmp_path: Path) -> None:
    depth = np.arange(960, dtype=np.uint16).reshape(24, 40) * 50
    Image.fromarray(depth).save(tmp_path / "d.png", icc_profile=P3)
    assert np.array_equal(read_depth(tmp_path / "d.png"), depth)


def test_the_plan_counts_what_is_converted_and_what_cannot_be(tmp_path: Path) -> None:
    for number in range(4):
        stored = {"icc_profile": P3} if number % 2 else {}
        Image.fromarray(muted(number)).save(tmp_path / f"p{number}.png", **stored)
    Image.fromarray(muted(9)).save(tmp_path / "q.png", icc_profile=b"nothing" * 40)
    found = scan(tmp_path, "s", Config(), cache=None)
    decisions = converted_colours(found.photos)
    assert decisions == ["2 of 5 photographs are Display P3: converted to sRGB"]
    (warning,) = [text for text in found.warnings if "colours" in text]
    assert "1 of 5" in warning and "q.png" in warning and "damaged" in warning


def test_curves_of_all_kinds_are_read() -> None:
    """Parametric and sampled curves of Pillow's and of our profiles agree with LittleCMS."""
    for profile in (P3, ADOBE, PROPHOTO, SRGB):
        read = icc.read_profile(profile)
        assert read is not None
        white = read.matrix.sum(axis=1)
        assert np.abs(white - [0.9642, 1.0, 0.8249]).max() < 1e-3
        assert (np.diff(read.curves, axis=1) >= 0).all()
