"""The same mask excludes the same pixels in every form in which programs write it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from pipeline.photos.load import load_mask, load_rgb, read_mask

HEIGHT, WIDTH = 48, 64
VALID = np.zeros((HEIGHT, WIDTH), bool)
VALID[8:40, 16:56] = True


def levels(dark: int, bright: int, dtype: type = np.uint8) -> np.ndarray:
    return np.where(VALID, bright, dark).astype(dtype)


def with_alpha(colours: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    return np.dstack([colours, alpha])


def rgb(dark: object, bright: object) -> np.ndarray:
    return np.where(VALID[..., None].repeat(3, 2), bright, dark).astype(np.uint8)


PHOTOGRAPH = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
WHITE = rgb(255, 255)
ALPHA = levels(0, 255)
PNG = {
    "black and white": levels(0, 255),
    "video range": levels(16, 235),
    "almost black": levels(1, 255),
    "0 and 1": levels(0, 1),
    "grey": levels(90, 170),
    "classes": levels(0, 3),
    "16 bits": levels(0, 65535, np.uint16),
    "16 bits, video range": levels(4112, 60395, np.uint16),
    "16 bits with 8-bit values": levels(0, 255, np.uint16),
    "coloured": rgb(0, (200, 0, 0)),
    "a dark class": rgb(0, (64, 0, 0)),
    "white, alpha": with_alpha(WHITE, ALPHA),
    "black, alpha": with_alpha(rgb(0, 0), ALPHA),
    "white, soft alpha": with_alpha(WHITE, levels(40, 220)),
    "black and white, opaque": with_alpha(rgb(0, 255), levels(255, 255)),
    "black and white, alpha 0 everywhere": with_alpha(rgb(0, 255), levels(0, 0)),
    "black and white, alpha": with_alpha(rgb(0, 255), ALPHA),
    "a photograph that is cut out": with_alpha(PHOTOGRAPH, ALPHA),
    "cut out, nothing behind": with_alpha(PHOTOGRAPH * VALID[..., None], ALPHA),
}


def write(path: Path, pixels: np.ndarray) -> Path:
    order = [2, 1, 0, 3][: pixels.shape[2]] if pixels.ndim == 3 else ...
    assert cv2.imwrite(str(path), pixels[..., order] if pixels.ndim == 3 else pixels)
    return path


@pytest.mark.parametrize("kind", sorted(PNG))
def test_png_masks(tmp_path: Path, kind: str) -> None:
    assert np.array_equal(load_mask(write(tmp_path / "m.png", PNG[kind])), VALID)


@pytest.mark.parametrize("kind", sorted(PNG))
def test_tiff_masks(tmp_path: Path, kind: str) -> None:
    pixels = PNG[kind]
    more = {"photometric": "rgb"} if pixels.ndim == 3 else {}
    more |= {"extrasamples": ["unassalpha"]} if pixels.ndim == 3 and pixels.shape[2] == 4 else {}
    tifffile.imwrite(tmp_path / "m.tif", pixels, metadata=None, **more)
    assert np.array_equal(load_mask(tmp_path / "m.tif"), VALID)


@pytest.mark.parametrize("dark", [0, 1, 5, 16, 60])
@pytest.mark.parametrize("bright", [200, 235, 254, 255])
@pytest.mark.parametrize("quality", [30, 75, 95])
def test_jpeg_masks_with_their_noise(tmp_path: Path, dark: int, bright: int, quality: int) -> None:
    Image.fromarray(levels(dark, bright)).save(tmp_path / "m.jpg", quality=quality)
    assert np.array_equal(load_mask(tmp_path / "m.jpg"), VALID)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp"])
def test_masks_of_one_bit_and_with_palettes(tmp_path: Path, suffix: str) -> None:
    Image.fromarray(VALID).save(tmp_path / f"bit{suffix}")
    assert np.array_equal(load_mask(tmp_path / f"bit{suffix}"), VALID)
    for colours in ([0, 0, 0, 255, 255, 255], [0, 0, 0, 128, 0, 0], [0, 0, 0, 1, 1, 1]):
        image = Image.fromarray(VALID.astype(np.uint8))
        image.putpalette(colours + [0] * (768 - len(colours)))
        image.save(tmp_path / f"palette{suffix}")
        assert np.array_equal(load_mask(tmp_path / f"palette{suffix}"), VALID), colours


def test_grey_and_alpha(tmp_path: Path) -> None:
    Image.fromarray(np.dstack([levels(255, 255), ALPHA]), "LA").save(tmp_path / "la.png")
    assert np.array_equal(load_mask(tmp_path / "la.png"), VALID)


@pytest.mark.parametrize("value", [0, 16, 100])
def test_a_dark_mask_keeps_nothing(tmp_path: Path, value: int) -> None:
    for name in ("m.png", "m.jpg"):
        Image.fromarray(levels(value, value)).save(tmp_path / name)
        assert not load_mask(tmp_path / name).any()
    alpha = with_alpha(WHITE, levels(0, 0))
    assert not load_mask(write(tmp_path / "a.png", alpha)).any()


@pytest.mark.parametrize("value", [200, 235, 255])
def test_a_bright_mask_keeps_everything(tmp_path: Path, value: int) -> None:
    for name in ("m.png", "m.jpg"):
        Image.fromarray(levels(value, value)).save(tmp_path / name)
        assert load_mask(tmp_path / name).all()


def test_numbers_of_classes_are_reported(tmp_path: Path) -> None:
    assert read_mask(write(tmp_path / "m.png", levels(0, 3))).darkest == 3
    assert read_mask(write(tmp_path / "m.png", levels(0, 1))).darkest is None
    assert read_mask(write(tmp_path / "m.png", levels(0, 255))).darkest is None


def test_masks_are_never_converted_by_a_profile(tmp_path: Path) -> None:
    """A linear profile would move the value 100 above half of the range."""
    from pipeline.io import icc

    profile = icc.write_profile("linear", icc.SRGB, (1.0,))
    mask = np.where(VALID, 255, 100).astype(np.uint8)[..., None].repeat(3, 2)
    Image.fromarray(mask).save(tmp_path / "m.png", icc_profile=profile)
    assert load_rgb(tmp_path / "m.png")[0, 0, 0] > 150
    assert np.array_equal(load_mask(tmp_path / "m.png"), VALID)
