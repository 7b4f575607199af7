"""Error maps, display orientation and sizes of images on the page."""

import io

import numpy as np
import pytest
from PIL import Image, ImageOps

from pipeline.reporting.data import Comparison
from pipeline.reporting.pictures import (
    ERROR_SCALE,
    MASKED_GREY,
    error_map,
    page_pictures,
    shrunk,
    upright,
)


def view(height: int = 30, width: int = 40, seed: int = 0, **more) -> Comparison:
    rng = np.random.default_rng(seed)
    photograph, render = rng.integers(0, 256, (2, height, width, 3), dtype=np.uint8)
    given = {"mask": None, "psnr": 20.0, "ssim": 0.5} | more
    return Comparison("median", "a.jpg", photograph, render, **given)


def test_error_map_gets_brighter_with_the_error_up_to_its_scale() -> None:
    reference = np.zeros((1, 5, 3))
    image = np.array([0, 0.05, 0.1, ERROR_SCALE, 1.0])[None, :, None].repeat(3, axis=2)
    luma = error_map(image, reference, None).astype(float) @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(luma[0, :4]) > 20)
    assert luma[0, 4] == luma[0, 3]
    assert luma[0, 0] < 3


def test_error_map_is_the_same_for_bytes_and_floats_and_greys_masked_pixels() -> None:
    v = view()
    mask = np.full((30, 40), 255, np.uint8)
    mask[:5] = 0
    from_bytes = error_map(v.render, v.photograph, mask)
    from_floats = error_map(v.render / 255.0, v.photograph / 255.0, mask)
    assert np.abs(from_bytes.astype(int) - from_floats).max() <= 4  # a step of the colour map
    assert np.all(from_bytes[:5] == MASKED_GREY)
    assert not np.any(np.all(from_bytes[5:] == MASKED_GREY, axis=2))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_upright_follows_exif(orientation: int) -> None:
    picture = view().photograph
    exif = Image.Exif()
    exif[0x0112] = orientation
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", exif=exif)
    expected = np.asarray(ImageOps.exif_transpose(Image.open(file)))
    np.testing.assert_array_equal(upright(picture, orientation), expected)


def test_an_unknown_orientation_leaves_the_picture() -> None:
    picture = view().photograph
    for orientation in (0, -1):
        np.testing.assert_array_equal(upright(picture, orientation), picture)


def test_shrinking_keeps_the_shape_and_never_enlarges() -> None:
    picture = np.zeros((100, 400, 3), np.uint8)
    assert shrunk(picture, 200).shape == (50, 200, 3)
    assert shrunk(picture, 400) is picture
    assert shrunk(np.zeros((1, 4000, 3), np.uint8), 100).shape == (1, 100, 3)


def test_pictures_of_a_page_stay_within_its_budget() -> None:
    """Noise compresses worst; ten such views stay within a few megabytes."""
    views = [view(700, 900, seed) for seed in range(4)]
    pictures = page_pictures(views)
    assert sum(len(picture.uri) for row in pictures for picture in row.values()) < 4_700_000
    shapes = [picture.width / picture.height for picture in pictures[0].values()]
    assert shapes == pytest.approx([9 / 7] * 3, rel=0.02)
