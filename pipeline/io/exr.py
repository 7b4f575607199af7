"""OpenEXR images: scene-linear colours in floating point, as renderers and HDR tools write them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

EXR_SUFFIXES = frozenset({".exr"})
# Larger images are refused before their pixels are decoded.
_MAX_PIXELS = 2**28
# Bytes of all channels in single precision, and of the colours and alpha that are made of them.
_MAX_DECODED = 3 << 30
_COLOUR_BYTES = 16


@dataclass(frozen=True)
class ExrHeader:
    """Size in pixels, and whether the image has an alpha channel."""

    width: int
    height: int
    alpha: bool


def read_header(file: IO[bytes]) -> ExrHeader:
    """The header of a file with colours in R, G, B or with luminance in Y.

    Raises:
        ValueError: not an OpenEXR file, or one without such channels; a crop of a larger image; or
            an impossible size.
    """
    part = _open(file, header_only=True)
    header = part.header()
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
    needed = width * height * (4 * len(header["channels"]) + _COLOUR_BYTES)
    if needed > _MAX_DECODED:
        raise ValueError(
            f"{width}x{height} pixels of {len(header['channels'])} channels take {needed >> 20} MiB"
            f", more than {_MAX_DECODED >> 20}; reduce it, or leave out channels"
        )
    return ExrHeader(width, height, "A" in names)


def read_pixels(file: IO[bytes]) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """(H, W, 3) linear RGB, as stored (multiplied by alpha), and (H, W) alpha or None.

    Raises:
        ValueError: as ``read_header``, or the pixels are damaged.
    """
    read_header(file)
    file.seek(0)
    channels = _open(file, header_only=False).channels()
    names = ("R", "G", "B") if "R" in channels else ("Y", "Y", "Y")
    planes = [np.asarray(channels[name].pixels, np.float32) for name in names]
    if len({plane.shape for plane in planes}) != 1:
        raise ValueError("its channels differ in size")
    alpha = np.asarray(channels["A"].pixels, np.float32) if "A" in channels else None
    return np.stack(planes, axis=-1), alpha


def _open(file: IO[bytes], *, header_only: bool) -> Any:
    import OpenEXR  # Imported only if the scene has such files.

    try:
        # One thread: scenes are read by several threads, an image each.
        return OpenEXR.File(file, separate_channels=True, header_only=header_only, num_threads=0)
    except (RuntimeError, TypeError) as error:
        raise ValueError(f"OpenEXR: {str(error).splitlines()[0]}") from None
