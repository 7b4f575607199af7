"""Image formats that Pillow decodes instead of OpenCV: AVIF; HEIC and HEIF if the package
``pillow-heif`` is installed.

Pillow decodes them to 8 bits. pillow-heif also applies the EXIF orientation; the decoded pixels
count as the stored ones, with orientation 1.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import IO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

AVIF_SUFFIXES = frozenset({".avif"})
HEIF_SUFFIXES = frozenset({".heic", ".heif"})


def heif_installed() -> bool:
    """Whether HEIF images can be read."""
    return find_spec("pillow_heif") is not None


SUFFIXES = AVIF_SUFFIXES | (HEIF_SUFFIXES if heif_installed() else frozenset())


def register(suffix: str) -> None:
    """Enable Pillow to open images with this suffix. Repeated calls have no effect."""
    if suffix in HEIF_SUFFIXES:
        import pillow_heif  # Optional dependency.

        pillow_heif.register_heif_opener()


def format_of(suffix: str) -> str:
    """Pillow's name of the format of files with this suffix, one of ``SUFFIXES``."""
    return "AVIF" if suffix in AVIF_SUFFIXES else "HEIF"


def read_pixels(file: IO[bytes], suffix: str) -> NDArray[np.uint8]:
    """(H, W, 3) BGR or (H, W, 4) BGRA, as OpenCV reads other pictures.

    Args:
        suffix: of the file, one of ``SUFFIXES``.

    Raises:
        OSError, ValueError, EOFError: no picture that can be decoded.
    """
    register(suffix)
    with Image.open(file, formats=[format_of(suffix)]) as image:
        mode = "RGBA" if "A" in image.mode else "RGB"
        pixels = np.asarray(image.convert(mode))
    order = [2, 1, 0, 3] if mode == "RGBA" else [2, 1, 0]
    return np.ascontiguousarray(pixels[..., order])
