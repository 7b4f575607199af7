"""HEIC and HEIF pictures, which phones write, where the package ``pillow-heif`` is installed.

It turns pictures upright and to 8 bits as it decodes, so their stored pixel grid is the upright one
for everything here; the EXIF orientation it reports is 1.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import IO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

HEIF_SUFFIXES = frozenset({".heic", ".heif"})


def installed() -> bool:
    """Whether HEIF pictures can be read."""
    return find_spec("pillow_heif") is not None


def register() -> None:
    """Let PIL open HEIF pictures; as often as one likes."""
    import pillow_heif  # Only scenes with such pictures pay for it.

    pillow_heif.register_heif_opener()


def read_pixels(file: IO[bytes]) -> NDArray[np.uint8]:
    """(H, W, 3) BGR or (H, W, 4) BGRA, as OpenCV reads other pictures.

    Raises:
        OSError, ValueError: no picture that can be decoded.
    """
    register()
    with Image.open(file) as image:
        mode = "RGBA" if "A" in image.mode else "RGB"
        pixels = np.asarray(image.convert(mode))
    order = [2, 1, 0, 3] if mode == "RGBA" else [2, 1, 0]
    return np.ascontiguousarray(pixels[..., order])
