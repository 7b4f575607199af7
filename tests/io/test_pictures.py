"""Pixels are as stored, in every format, whatever orientation a file names, and whoever decodes
them."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from pipeline.config.schema import Config
from pipeline.io import pillow_formats, tiff
from pipeline.io.photofile import read_facts
from pipeline.io.pictures import decode_depth, decode_mask, decode_photograph
from pipeline.photos.load import load_mask, load_rgba, read_depth
from pipeline.photos.verify import verify_photos
from pipeline.plan.scan import scan
from pipeline.runtime.errors import UserError
from pipeline.sfm.sift import DetectionImage

ORIENTATION = 0x0112
LOSSLESS = {
    ".png": {},
    ".tif": {},
    ".tiff": {"compression": "tiff_lzw"},
    ".webp": {"lossless": True, "exact": True},
    ".bmp": {},
}
LOSSY = {".jpg": {"quality": 95, "subsampling": 0}, ".avif": {"quality": 95}}
FORMATS = LOSSLESS | LOSSY


def pattern(height: int = 24, width: int = 40, seed: int = 0) -> np.ndarray:
    """(H, W, 3) blocks of 8 pixels, all different."""
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, 256, (height // 8, width // 8, 3), np.uint8)
    return np.kron(blocks, np.ones((8, 8, 1), np.uint8))


def save(path: Path, pixels: np.ndarray, orientation: int, **options: object) -> None:
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    more = {} if path.suffix == ".bmp" else {"exif": exif}
    Image.fromarray(pixels).save(path, **FORMATS[path.suffix], **more, **options)


def tiff_bytes(pixels: np.ndarray, orientation: int = 1, **options: object) -> bytes:
    buffer = io.BytesIO()
    extra = [(ORIENTATION, "H", 1, orientation, True)]
    tifffile.imwrite(buffer, pixels, metadata=None, extratags=extra, **options)
    return buffer.getvalue()


@given(
    suffix=st.sampled_from(sorted(FORMATS)),
    orientation=st.integers(1, 8),
    kind=st.sampled_from(["RGB", "RGBA", "L"]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=150, deadline=None)
def test_decoded_pixels_are_the_stored_ones(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, orientation: int, kind: str, seed: int
) -> None:
    if kind == "RGBA" and suffix in (".jpg", ".bmp"):
        kind = "RGB"
    pixels = pattern(seed=seed)
    if kind == "RGBA":
        pixels = np.dstack([pixels, pattern(seed=seed + 1)[..., 0]])
    elif kind == "L":
        pixels = pixels[..., 0]
    path = tmp_path_factory.mktemp("x") / f"a{suffix}"
    save(path, np.ascontiguousarray(pixels), orientation)
    rgb, alpha = load_rgba(path)
    facts = read_facts(path)
    assert (facts.width, facts.height) == (40, 24)
    assert suffix == ".bmp" or facts.orientation == orientation
    expected = pixels[..., None].repeat(3, 2) if kind == "L" else pixels[..., :3]
    if alpha is not None:
        assert np.abs(alpha.astype(int) - pixels[..., 3]).max() <= 8
    assert (alpha is not None) == (kind == "RGBA")
    difference = np.abs(rgb.astype(int) - expected)
    if suffix in LOSSLESS:
        assert difference.max() == 0
    else:
        assert difference.mean() < 16


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", sorted(LOSSLESS))
def test_masks_are_as_stored(tmp_path: Path, suffix: str, orientation: int) -> None:
    valid = pattern()[..., 0] > 100
    save(tmp_path / f"m{suffix}", np.where(valid, 255, 0).astype(np.uint8), orientation)
    assert np.array_equal(load_mask(tmp_path / f"m{suffix}"), valid)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.float64])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
def test_depth_maps_are_as_stored(orientation: int, dtype: type, order: str, big: bool) -> None:
    depth = pattern()[..., 0].astype(np.dtype(dtype).newbyteorder(order))
    data = tiff_bytes(depth, orientation, byteorder=order, bigtiff=big)
    read = decode_depth(data)
    assert read is not None and np.array_equal(read, depth)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_depth_map_of_16_bits_png_with_orientation(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    depth = pattern()[..., 0].astype(np.uint16) * 200
    Image.fromarray(depth).save(tmp_path / "d.png", exif=exif)
    assert np.array_equal(read_depth(tmp_path / "d.png"), depth)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp", ".avif"])
def test_all_who_decode_a_photograph_see_the_same(tmp_path: Path, suffix: str) -> None:
    """The plan's size, the check of the inspect stage, features and training."""
    for number in range(1, 9):
        save(tmp_path / f"p{number}{suffix}", pattern(seed=number), number)
        save_mask = Image.fromarray(pattern(seed=number)[..., 0] // 128 * 255)
        (tmp_path / "masks").mkdir(exist_ok=True)
        save_mask.save(tmp_path / "masks" / f"p{number}.png")
    found = scan(tmp_path, "s", Config(), cache=None)
    assert {photo.orientation for photo in found.photos} == set(range(1, 9))
    checked, warnings = verify_photos(found.manifest, threads=1, keep_duplicates=True)
    assert warnings == [] and len(checked.photos) == 8
    for photo in found.photos:
        rgb, _ = load_rgba(photo.path)
        assert rgb.shape == (photo.height, photo.width, 3) == (24, 40, 3)
        picture = DetectionImage(photo, 1000)
        assert np.array_equal(picture.rgb, rgb)
        assert picture.usable is not None and photo.mask is not None
        assert np.array_equal(picture.usable > 0, load_mask(photo.mask))


@pytest.mark.skipif(not pillow_formats.heif_installed(), reason="not run: pillow-heif missing")
def test_heif_is_rotated_by_its_decoder_and_by_nobody_else(tmp_path: Path) -> None:
    pillow_formats.register(".heic")
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    Image.fromarray(pattern()).save(tmp_path / "a.heic", exif=exif.tobytes())
    facts, (rgb, _) = read_facts(tmp_path / "a.heic"), load_rgba(tmp_path / "a.heic")
    assert rgb.shape == (facts.height, facts.width, 3) and facts.orientation == 1


def test_tiff_of_every_kind_has_its_own_colours() -> None:
    """OpenCV multiplies colours by alpha, and reads planes as if they were interleaved."""
    rgb, alpha = pattern(), pattern(seed=1)[..., 0] | 1
    deep, deep_alpha = rgb.astype(np.uint16) * 257, alpha.astype(np.uint16) * 257
    rgba, deep_rgba = np.dstack([rgb, alpha]), np.dstack([deep, deep_alpha])
    multiplied = np.rint(deep * (deep_alpha[..., None] / 65535)).astype(np.uint16)

    def read(pixels: np.ndarray, **options: object) -> np.ndarray:
        found = decode_photograph(tiff_bytes(pixels, **options), "a.tif")
        return found if found.ndim == 2 else found[..., [2, 1, 0, *range(3, found.shape[2])]]

    colours = {"photometric": "rgb"}
    straight, premultiplied = {"extrasamples": ["unassalpha"]}, {"extrasamples": ["assocalpha"]}
    assert np.array_equal(read(rgba, **colours, **straight), rgba)
    assert np.array_equal(read(deep_rgba, **colours, **straight), deep_rgba)
    assert np.array_equal(read(rgba, **colours, extrasamples=["unspecified"]), rgb)
    assert np.array_equal(read(deep_rgba, **colours, extrasamples=["unspecified"]), deep)
    found = read(np.dstack([multiplied, deep_alpha]), **colours, **premultiplied)
    assert np.abs(found[..., :3].astype(int) - deep)[alpha > 20].max() < 257 * 13
    for pixels in (rgb, deep):
        planes = np.ascontiguousarray(np.moveaxis(pixels, 2, 0))
        assert np.array_equal(read(planes, **colours, planarconfig="separate"), pixels)
    for grey in (rgb[..., 0], deep[..., 0]):
        assert np.array_equal(read(np.iinfo(grey.dtype).max - grey, photometric="miniswhite"), grey)
    inks = np.asarray(Image.fromarray(rgb).convert("CMYK"))
    for pixels in (inks, inks.astype(np.uint16) * 257):
        printed = read(pixels, photometric="separated", planarconfig="contig")
        assert np.array_equal(printed, rgb)


def test_one_transparent_level_of_a_grey_png_is_alpha(tmp_path: Path) -> None:
    grey = pattern()[..., 0].copy()
    Image.fromarray(grey).save(tmp_path / "a.png", transparency=int(grey[0, 0]))
    _, alpha = load_rgba(tmp_path / "a.png")
    assert alpha is not None and np.array_equal(alpha == 0, grey == grey[0, 0])


def test_cmyk_without_a_profile_is_converted(tmp_path: Path) -> None:
    Image.fromarray(pattern()).convert("CMYK").save(tmp_path / "a.jpg", quality=100)
    assert np.abs(load_rgba(tmp_path / "a.jpg")[0].astype(int) - pattern()).mean() < 2
    assert "CMYK" in read_facts(tmp_path / "a.jpg").colours_fault


@pytest.mark.filterwarnings("ignore:Corrupt EXIF data")
@given(data=st.binary(max_size=200), start=st.sampled_from([b"II*\0", b"MM\0*", b"II+\0"]))
def test_a_damaged_directory_is_left_to_the_decoder(data: bytes, start: bytes) -> None:
    assert len(tiff.without_orientation(start + data)) == len(data) + 4
    with pytest.raises(ValueError):
        decode_photograph(start + data, "a.tif")
    with pytest.raises(ValueError):
        decode_mask(start + data, "a.tif")


def test_a_picture_that_is_too_large_says_so(tmp_path: Path) -> None:
    ok, data = cv2.imencode(".png", np.zeros((4, 4), np.uint8))
    assert ok
    broken = bytearray(data.tobytes())
    broken[16:24] = (1 << 20).to_bytes(4, "big") * 2
    (tmp_path / "a.png").write_bytes(broken)
    with pytest.raises(UserError, match=r"a\.png"):
        load_rgba(tmp_path / "a.png")
