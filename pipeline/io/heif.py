"""HEIC and HEIF images, read if the package ``pillow-heif`` is installed.

pillow-heif applies the EXIF orientation and converts to 8 bits when it decodes; the decoded pixels
count as the stored ones, with orientation 1.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import IO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

HEIF_SUFFIXES = frozenset({".heic", ".heif"})


def installed() -> bool:
    """Whether HEIF images can be read."""
    return find_spec("pillow_heif") is not None


def register() -> None:
    """Enable PIL to open HEIF images. Repeated calls have no effect."""
    import pillow_heif  # Optional dependency.

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
