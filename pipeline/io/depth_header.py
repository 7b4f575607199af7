"""The shape and the type of a depth map's values, from the header of its file."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import IO

import numpy as np
from PIL import Image
from pydantic import BaseModel, ConfigDict

from pipeline.io.arrays import read_array_header
from pipeline.io.bounded import opened_regular
from pipeline.io.names import suffix_of

#: Suffixes that a scene's depth maps have, but that cannot be read.
UNREAD = frozenset({".exr"})
# Pillow's modes with one channel of numbers. The channels of other modes are counted.
_ONE_CHANNEL = frozenset({"1", "L", "F", "I", "I;16", "I;16B", "I;16L", "I;16N"})


class DepthHeader(BaseModel):
    """What the header of a depth map says.

    Attributes:
        width, height: The size in pixels.
        channels: The number of values of a pixel.
        is_number: Whether the values are integers or floats.
    """

    model_config = ConfigDict(frozen=True)

    width: int
    height: int
    channels: int = 1
    is_number: bool = True


def read_depth_header(path: Path) -> DepthHeader | None:
    """The header of a depth map. None if it cannot be parsed, which is no error: the decoder of the
    pixels may accept more.

    Raises:
        OSError: the file cannot be read.
    """
    with opened_regular(path) as file:
        # ``read_depth`` accepts the same suffixes.
        try:
            if suffix_of(path.name) == ".npy":
                return _of_array(file)
            if suffix_of(path.name) == ".npz":
                with zipfile.ZipFile(file) as archive:
                    first = next(iter(archive.infolist()), None)
                    if first is None:
                        return None
                    with archive.open(first) as entry:
                        return _of_array(entry)
            if suffix_of(path.name) == ".pfm":
                return _of_pfm(file)
            return _of_image(file)
        # Headers are parsed by libraries, with exceptions of many types.
        except Exception:
            return None


def _of_array(file: IO[bytes]) -> DepthHeader:
    shape, _, dtype = read_array_header(file)
    height, width, *rest = shape if len(shape) >= 2 else (0, 0)
    return DepthHeader(
        width=width,
        height=height,
        channels=int(np.prod(rest, dtype=np.int64)) if len(rest) < 2 else 0,
        is_number=dtype.kind in "uif",
    )


def _of_pfm(file: IO[bytes]) -> DepthHeader:
    kind, width, height, *_ = file.read(200).split(maxsplit=3)
    return DepthHeader(width=int(width), height=int(height), channels=3 if kind == b"PF" else 1)


def _of_image(file: IO[bytes]) -> DepthHeader:
    with Image.open(file) as image:
        # A palette is decoded to colours.
        bands = 3 if image.mode == "P" else len(image.getbands())
        channels = 1 if image.mode in _ONE_CHANNEL else bands
        return DepthHeader(width=image.width, height=image.height, channels=channels)
