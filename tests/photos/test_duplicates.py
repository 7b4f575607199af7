"""Photographs that show the same are found, others are not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.photos.duplicates import Signature, find_duplicates, signature
from tests.tools import need_data


def scene(seed: int = 0, size: tuple[int, int] = (480, 360)) -> np.ndarray:
    """A smooth picture of 1/f noise, as photographs have, with a black border."""
    rng = np.random.default_rng(seed)
    picture = np.zeros((size[1], size[0], 3), np.float32)
    for octave in range(6):
        small = rng.normal(size=(6 * 2**octave, 8 * 2**octave, 3)).astype(np.float32)
        picture += cv2.resize(small, size, interpolation=cv2.INTER_CUBIC) / 1.7**octave
    picture = (128 + 40 * picture).clip(0, 255)
    picture[:40] = picture[-40:] = 0
    return picture.astype(np.uint8)


def signed(**pictures: np.ndarray | Image.Image) -> dict[str, Signature]:
    return {
        name: signature(p if isinstance(p, Image.Image) else Image.fromarray(p))
        for name, p in pictures.items()
    }


def shifted(picture: np.ndarray, pixels: float) -> np.ndarray:
    matrix = np.array([[1, 0, pixels], [0, 1, 0]], np.float32)
    return np.asarray(cv2.warpAffine(picture, matrix, picture.shape[1::-1]))


def test_reduced_and_compressed_copies_are_left_out_and_the_largest_is_kept() -> None:
    large = scene()
    _, data = cv2.imencode(".jpg", large, [cv2.IMWRITE_JPEG_QUALITY, 70])
    compressed = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    half = cv2.resize(large, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    found = find_duplicates(signed(a_half=half, b=large, c=compressed, other=scene(1)))
    assert found.keys() == {"a_half", "c"} or found.keys() == {"a_half", "b"}
    assert "other" not in {*found, *found.values()}


def test_the_sharpest_of_a_burst_is_kept() -> None:
    noise = np.random.default_rng(0)
    sharp = scene()
    burst = {f"f{i}": cv2.GaussianBlur(sharp, (0, 0), 0.8) for i in range(3)}
    for picture in [*burst.values(), sharp]:
        picture += noise.integers(0, 3, picture.shape, np.uint8)
    assert find_duplicates(signed(**burst, g=sharp)) == {"f0": "g", "f1": "g", "f2": "g"}


def test_a_moved_camera_is_no_duplicate() -> None:
    """A hundredth of the width, in a picture half of which never changes."""
    picture = scene()
    assert find_duplicates(signed(a=picture, b=shifted(picture, 5))) == {}


@pytest.mark.parametrize("mode", ["L", "RGBA", "I;16", "P", "CMYK"])
def test_every_kind_of_image_has_a_signature(mode: str) -> None:
    grey = cv2.cvtColor(scene(), cv2.COLOR_RGB2GRAY)
    if mode == "I;16":
        image = Image.fromarray(grey.astype(np.uint16) * 257)
    else:
        image = Image.fromarray(scene()).convert(mode)
    assert find_duplicates(signed(a=image, b=scene(1))) == {}
    assert find_duplicates(signed(a=image, b=grey)).keys() <= {"a", "b"}


def test_featureless_images_are_duplicates() -> None:
    assert (
        len(
            find_duplicates(
                signed(a=np.full((50, 60), 9, np.uint8), b=np.full((50, 60), 200, np.uint8))
            )
        )
        == 1
    )


@pytest.mark.parametrize("name", ["fox", "lund_door", "monstree", "strecha_fountain_p11"])
def test_photographs_of_real_scenes_are_kept(name: str) -> None:
    folder: Path = need_data(f"{name}/images")
    signatures = {}
    for path in sorted(folder.iterdir())[:20]:
        with Image.open(path) as image:
            signatures[path.name] = signature(image)
    assert find_duplicates(signatures) == {}
