"""Finding photographs of which a scene has several: copies, reduced copies, and bursts of a camera
that stood still.

They add no parallax, and a test view with a copy among the training views makes the metrics too
good.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

# The side in pixels of the thumbnails that are compared.
SIDE = 96
# The side of the neighbourhood in which contrast is normalised, and the standard deviation in grey
# levels below which it is noise. Without it, parts that never change (the black border of a fisheye
# image) would outweigh those that do.
NEIGHBOURHOOD, NOISE = 9, 2.0
# The largest difference of duplicates: the root mean square of the difference of thumbnails over
# that of a thumbnail. A copy at half the size or as JPEG of quality 70 differs by 0.03 to 0.15, a
# shift by a thousandth of the width by 0.1 to 0.2; different photographs of one scene by 0.8 or
# more, renders of nearly symmetric objects by 0.25.
MAX_DIFFERENCE = 0.15
# The long side in pixels at which sharpness is measured.
SHARPNESS_PX = 640
# The number of rows of the matrix of differences that are computed at a time.
_ROWS = 256


@dataclass(frozen=True)
class Signature:
    """The properties by which duplicates are recognised.

    Attributes:
        thumbnail: (SIDE, SIDE) int8 image with locally normalised contrast.
        pixels: The number of pixels of the photograph.
        sharpness: The variance of the Laplacian, which is comparable between duplicates only.
    """

    thumbnail: NDArray[np.int8]
    pixels: int
    sharpness: float


def signature(image: Image.Image) -> Signature:
    """The signature of a decoded image."""
    grey = _grey(image)
    small = cv2.resize(grey, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
    size = (NEIGHBOURHOOD, NEIGHBOURHOOD)
    mean = cv2.blur(small, size)
    variance = np.maximum(cv2.blur(small * small, size) - mean * mean, 0) + NOISE**2
    normalised = (small - mean) / np.sqrt(variance)
    scale = min(1.0, SHARPNESS_PX / max(grey.shape))
    reduced = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    sharpness = float(np.var(cv2.Laplacian(reduced, cv2.CV_32F), dtype=np.float64))
    # The normalised values of real images are between -4 and 4.
    return Signature(np.rint(normalised.clip(-4, 4) * 31).astype(np.int8), grey.size, sharpness)


def find_duplicates(signatures: Mapping[str, Signature]) -> dict[str, str]:
    """The name of the photograph that is kept instead of each duplicate, by the duplicate's name.

    The largest is kept, of equally large ones the sharpest, of these the first by name. No two kept
    photographs are duplicates of each other.
    """
    order = sorted(
        signatures, key=lambda name: (-signatures[name].pixels, -signatures[name].sharpness, name)
    )
    if not order:
        return {}
    # Sums of integers are exact in float64, whatever the order of summation.
    thumbnails = np.stack([signatures[name].thumbnail.ravel() for name in order]).astype(np.float64)
    power = (thumbnails**2).sum(axis=1)
    kept: list[int] = []
    replaced: dict[str, str] = {}
    for start in range(0, len(order), _ROWS):
        products = thumbnails[start : start + _ROWS] @ thumbnails.T
        for i, product in enumerate(products, start=start):
            difference = power[i] + power[kept] - 2 * product[kept]
            limit = MAX_DIFFERENCE**2 * np.minimum(power[i], power[kept])
            same = np.flatnonzero(difference <= limit)
            if len(same):
                replaced[order[i]] = order[kept[same[0]]]
            else:
                kept.append(i)
    return dict(sorted(replaced.items()))


def _grey(image: Image.Image) -> NDArray[np.uint8]:
    """(H, W) grey levels of an image of any mode."""
    if image.mode.startswith("I"):  # PIL would clip images of 16 bits.
        values = np.asarray(image).astype(np.float32) / 257
        return np.asarray(values.clip(0, 255), np.uint8)
    if "A" in image.mode:
        # Colours of transparent pixels are arbitrary.
        white = Image.new("RGBA", image.size, (255, 255, 255, 255))
        image = Image.alpha_composite(white, image.convert("RGBA"))
    return np.asarray(image.convert("L"))
