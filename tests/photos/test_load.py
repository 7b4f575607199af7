"""Images are loaded as stored; damaged files are errors that name them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.io.recorded import digest_of
from pipeline.photos.load import load_depth, load_mask, load_rgb, load_rgba, load_view
from pipeline.runtime.errors import UserError
from pipeline.scene.views import View


def view_of(path: Path, mask: Path | None, width: int, height: int, **more: str) -> View:
    file = None if mask is None else str(mask)
    size = (width, height, 1.0, 1.0, 0.0, 0.0)
    return View("v", str(path), file, *size, np.eye(4), is_test=False, **more)  # type: ignore[arg-type]


def gradient(height: int = 24, width: int = 36) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 7, y * 10, (x + y) * 4], axis=2).astype(np.uint8)


def test_png_is_loaded_losslessly_in_rgb_order(tmp_path: Path) -> None:
    rgb = gradient()
    Image.fromarray(rgb).save(tmp_path / "a.png")
    assert np.array_equal(load_rgb(tmp_path / "a.png"), rgb)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_exif_orientation_is_not_applied(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(gradient()).save(tmp_path / "a.jpg", quality=95, exif=exif)
    read = load_rgb(tmp_path / "a.jpg")
    assert read.shape == (24, 36, 3)
    assert np.abs(read.astype(int) - gradient()).mean() < 6


def test_grey_palette_and_16_bit_have_three_channels(tmp_path: Path) -> None:
    rgb = gradient()
    Image.fromarray(rgb[..., 0]).save(tmp_path / "grey.png")
    assert np.array_equal(load_rgb(tmp_path / "grey.png"), rgb[..., :1].repeat(3, 2))
    Image.fromarray(rgb).quantize(16).save(tmp_path / "palette.png")
    assert load_rgb(tmp_path / "palette.png").shape == rgb.shape
    cv2.imwrite(str(tmp_path / "deep.png"), rgb[..., ::-1].astype(np.uint16) * 257)
    deep = load_rgb(tmp_path / "deep.png")
    assert deep.dtype == np.uint16 and np.array_equal(deep, rgb.astype(np.uint16) * 257)
    assert np.array_equal(load_rgba(tmp_path / "deep.png")[0], rgb)


def test_alpha_is_separated_for_colour_and_grey(tmp_path: Path) -> None:
    rgb, alpha = gradient(), gradient()[..., 1]
    Image.fromarray(np.dstack([rgb, alpha])).save(tmp_path / "rgba.png")
    Image.fromarray(np.dstack([rgb[..., 0], alpha]), "LA").save(tmp_path / "la.png")
    for name in ("rgba.png", "la.png"):
        read, read_alpha = load_rgba(tmp_path / name)
        assert read_alpha is not None and np.array_equal(read_alpha, alpha)
        assert np.array_equal(read[..., 0], rgb[..., 0])


def test_transparent_colours_have_no_influence_when_resized(tmp_path: Path) -> None:
    rgba = np.zeros((8, 8, 4), np.uint8)
    rgba[..., 1] = 255  # green where transparent
    rgba[:, ::2] = (200, 10, 30, 255)
    Image.fromarray(rgba).save(tmp_path / "a.png")
    view = load_view(view_of(tmp_path / "a.png", None, 4, 4))
    assert view.alpha is not None
    assert np.all(view.rgb == (200, 10, 30)) and np.all(view.alpha == 128)


def test_images_are_resized_by_area_and_partly_masked_pixels_are_masked(tmp_path: Path) -> None:
    rgb = gradient()
    mask = np.zeros((24, 36), np.uint8)
    mask[:, :19] = 1  # any non-zero value is valid
    Image.fromarray(rgb).save(tmp_path / "a.png")
    Image.fromarray(mask).save(tmp_path / "m.png")
    view = load_view(view_of(tmp_path / "a.png", tmp_path / "m.png", 18, 12))
    expected = rgb.reshape(12, 2, 18, 2, 3).mean(axis=(1, 3))
    assert np.abs(view.rgb - expected).max() <= 0.5
    assert view.mask is not None
    assert view.mask[:, :9].all() and not view.mask[:, 9:].any()
    assert load_mask(tmp_path / "m.png").sum() == 24 * 19


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.95])
def test_a_truncated_file_is_an_error(tmp_path: Path, suffix: str, share: float) -> None:
    rng = np.random.default_rng(0)
    picture = Image.fromarray(rng.integers(0, 255, (64, 64, 3), np.uint8))
    path = tmp_path / f"photo.{suffix}"
    picture.save(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(UserError, match=f"photo.{suffix}"):
        load_rgb(path)


def test_a_truncated_jpeg_with_a_complete_exif_preview_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(gradient()).save(path)
    whole = path.read_bytes()
    preview = b"\xff\xe1" + (len(whole) + 2).to_bytes(2, "big") + whole
    path.write_bytes(whole[:2] + preview + whole[2:])
    assert load_rgb(path).shape == (24, 36, 3)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(UserError, match="truncated"):
        load_rgb(path)


def test_a_damaged_png_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(gradient()).save(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(bytes(data))
    with pytest.raises(UserError, match="damaged"):
        load_rgb(path)


def test_text_missing_files_and_rotated_images_are_errors(tmp_path: Path) -> None:
    (tmp_path / "text.jpg").write_text("not an image")
    with pytest.raises(UserError, match=r"text\.jpg: not a readable image"):
        load_rgb(tmp_path / "text.jpg")
    with pytest.raises(UserError, match=r"gone\.png: cannot be read"):
        load_rgb(tmp_path / "gone.png")
    Image.fromarray(gradient()).save(tmp_path / "a.png")
    with pytest.raises(UserError, match="36x24"):
        load_view(view_of(tmp_path / "a.png", None, 24, 36))


def test_a_file_with_another_digest_is_an_error(tmp_path: Path) -> None:
    Image.fromarray(gradient()).save(tmp_path / "a.png")
    Image.new("L", (36, 24), 255).save(tmp_path / "m.png")
    np.save(tmp_path / "d.npy", np.ones((24, 36)))
    digest = {name: digest_of(tmp_path / name) for name in ("a.png", "m.png", "d.npy")}
    view = view_of(
        tmp_path / "a.png",
        tmp_path / "m.png",
        36,
        24,
        image_digest=digest["a.png"],
        mask_digest=digest["m.png"],
    )
    assert np.array_equal(load_view(view).rgb, gradient())
    assert load_depth(tmp_path / "d.npy", 1.5, digest["d.npy"]).shape == (24, 36)
    Image.new("L", (36, 24), 0).save(tmp_path / "m.png")
    with pytest.raises(UserError, match=r"m\.png: has changed since the scene was inspected"):
        load_view(view)
    Image.fromarray(gradient()[::-1]).save(tmp_path / "a.png")
    with pytest.raises(UserError, match=r"a\.png: has changed .*\n.*run the same command"):
        load_view(view)
    np.save(tmp_path / "d.npy", np.zeros((24, 36)))
    with pytest.raises(UserError, match=r"d\.npy: has changed"):
        load_depth(tmp_path / "d.npy", 1.5, digest["d.npy"])
