"""OpenEXR images: scene-linear colours in floating point, as renderers and HDR tools write them.

The attribute ``chromaticities`` gives the primaries; without it they are those of sRGB (OpenEXR,
"Standard Attributes").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.io import icc

EXR_SUFFIXES = frozenset({".exr"})
# Larger images are refused before their pixels are decoded.
_MAX_PIXELS = 2**28
# Bytes of all channels in single precision, and of the colours and alpha that are made of them.
_MAX_DECODED = 3 << 30
_COLOUR_BYTES = 16
# Largest difference from the identity of a matrix that changes no 8-bit value by more than one.
_SRGB_TOLERANCE = 2e-3


@dataclass(frozen=True)
class ExrHeader:
    """The header of an image.

    Attributes:
        width, height: The size in pixels.
        alpha: Whether there is an alpha channel.
        to_srgb: The (3, 3) matrix from the colours to linear sRGB; None if they are sRGB.
        fault: Why the colours are used as sRGB although the file says something else; empty
            otherwise.
    """

    width: int
    height: int
    alpha: bool
    to_srgb: NDArray[np.float64] | None = None
    fault: str = ""


def read_header(file: IO[bytes]) -> ExrHeader:
    """The header of a file with colours in R, G, B or with luminance in Y.

    Raises:
        ValueError: The file is not OpenEXR, lacks such channels, is a crop of a larger image, or
            has an impossible size.
    """
    opened = _open(file, header_only=True)
    header = opened.header()
    names = {channel.name for channel in header["channels"]}
    if not {"R", "G", "B"} <= names and "Y" not in names:
        raise ValueError(f"expected channels R, G, B or Y, found {', '.join(sorted(names)[:8])}")
    (left, top), (right, bottom) = (corner.tolist() for corner in header["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    if [corner.tolist() for corner in header["displayWindow"]] != [[left, top], [right, bottom]]:
        raise ValueError("its data window is not its display window: a crop of a larger image")
    if width <= 0 or height <= 0 or width * height > _MAX_PIXELS:
        raise ValueError(f"impossible size {width}x{height}")
    if "deep" in str(header.get("type", "")):
        raise ValueError("expected one colour a pixel, found several (deep data)")
    # All parts are decoded, not only the first.
    parts = [part.header for part in opened.parts]
    needed = width * height * _COLOUR_BYTES + sum(_decoded_bytes(part) for part in parts)
    if needed > _MAX_DECODED:
        count = sum(len(part["channels"]) for part in parts)
        raise ValueError(
            f"{width}x{height} pixels of {count} channels take {needed >> 20} MiB, more than "
            f"{_MAX_DECODED >> 20}; reduce it, or leave out channels and parts"
        )
    to_srgb, fault = None, ""
    if "chromaticities" in header and {"R", "G", "B"} <= names:
        try:
            to_srgb = _to_srgb(header["chromaticities"])
        except (TypeError, ValueError):
            fault = "impossible chromaticities"
    return ExrHeader(width, height, "A" in names, to_srgb, fault)


def _decoded_bytes(header: Any) -> int:
    """Bytes of the channels of a part, and of a tile, which are decoded as a whole."""
    (left, top), (right, bottom) = (corner.tolist() for corner in header["dataWindow"])
    pixels = max(right - left + 1, 0) * max(bottom - top + 1, 0)
    tile = header.get("tiles")
    if tile is not None:
        pixels += tile.xSize * tile.ySize
    return int(pixels * 4 * len(header["channels"]))


def read_pixels(file: IO[bytes]) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """(H, W, 3) linear sRGB, multiplied by alpha as stored, and (H, W) alpha or None.

    Raises:
        ValueError: See ``read_header``; or the pixels are damaged.
    """
    found = read_header(file)
    file.seek(0)
    channels = _open(file, header_only=False).channels()
    names = ("R", "G", "B") if "R" in channels else ("Y", "Y", "Y")
    planes = [np.asarray(channels[name].pixels, np.float32) for name in names]
    if len({plane.shape for plane in planes}) != 1:
        raise ValueError("its channels differ in size")
    alpha = np.asarray(channels["A"].pixels, np.float32) if "A" in channels else None
    rgb = np.stack(planes, axis=-1)
    if found.to_srgb is not None:
        # A matrix product of BLAS may round differently with the number of threads.
        rows = found.to_srgb.astype(np.float32)
        rgb = np.stack([sum(row[k] * planes[k] for k in range(3)) for row in rows], axis=-1)
    return rgb, alpha


def _to_srgb(values: Sequence[float]) -> NDArray[np.float64] | None:
    """The matrix for the attribute ``chromaticities``: x and y of red, green, blue and white.

    Raises:
        ValueError: No colours have these chromaticities.
    """
    numbers = [float(value) for value in values]
    if len(numbers) != 8:
        raise ValueError("expected eight chromaticities")
    red, green, blue, white = zip(numbers[::2], numbers[1::2], strict=True)
    matrix = np.linalg.solve(icc.matrix_of(icc.SRGB), icc.matrix_of((red, green, blue, white)))
    return None if np.allclose(matrix, np.eye(3), atol=_SRGB_TOLERANCE) else np.asarray(matrix)


def _open(file: IO[bytes], *, header_only: bool) -> Any:
    import OpenEXR  # Imported only if the scene has such files.

    try:
        # Use one thread: scenes are read by several threads, an image each.
        return OpenEXR.File(file, separate_channels=True, header_only=header_only, num_threads=0)
    except (RuntimeError, TypeError) as error:
        raise ValueError(f"OpenEXR: {str(error).splitlines()[0]}") from None
