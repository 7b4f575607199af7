"""Image formats that Pillow decodes instead of OpenCV: AVIF; HEIC and HEIF if the package
``pillow-heif`` is installed.

Pillow decodes them to 8 bits. pillow-heif also applies the rotation that HEIF stores; the decoded
pixels count as the stored ones, with orientation 1.
"""

from __future__ import annotations

from importlib.util import find_spec

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
