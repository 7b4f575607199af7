"""Checks of a scene's depth maps by their headers, before any job starts."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import cast

from pipeline.io.depth_header import UNREAD, DepthHeader, read_depth_header
from pipeline.io.fact_cache import FactCache
from pipeline.io.names import suffix_of
from pipeline.io.photofile import FileFacts
from pipeline.runtime.errors import UserError

_OPTIONAL_HEADER = cast("type[DepthHeader | None]", DepthHeader | None)
# The relative difference of the aspect ratios of a depth map and its photograph; rounding of
# reduced maps causes less.
_ASPECT_TOLERANCE = 0.02
_FIX = (
    "save depths of the whole photograph as 16-bit grey PNG, float TIFF or .npy, or remove "
    "the file from the folder"
)


def check_depth_maps(
    depths: Mapping[str, Path], photos: Mapping[str, FileFacts], cache: FactCache
) -> None:
    """Check the form of the depth map of each photograph.

    Raises:
        UserError: A map has a format that cannot be read, several channels, values that are no
            numbers, or another aspect ratio than its photograph.
    """
    for name, path in sorted(depths.items()):
        if suffix_of(path.name) in UNREAD:
            kind = suffix_of(path.name)[1:].upper()
            raise UserError(f"the depth map cannot be read: {kind} files", file=path, fix=_FIX)
        header = cache.get(path, "depth", _OPTIONAL_HEADER, partial(read_depth_header, path))
        if header is not None:
            _check(name, path, header, photos[name])


def _check(name: str, path: Path, header: DepthHeader, photo: FileFacts) -> None:
    if header.channels != 1 or not header.is_number or min(header.width, header.height) < 1:
        found = f"{header.channels} channels" if header.is_number else "values that are no numbers"
        raise UserError(
            f"expected a depth map of one channel of numbers, found {header.width}x{header.height} "
            f"pixels with {found}",
            file=path,
            fix=_FIX,
        )
    tolerance = _ASPECT_TOLERANCE + 1 / min(header.width, header.height)
    ratio = header.width / header.height / (photo.width / photo.height)
    if abs(ratio - 1) > tolerance:
        turned = (header.height, header.width) == (photo.width, photo.height)
        raise UserError(
            f"the depth map is {header.width}x{header.height} pixels, another aspect ratio than "
            f"that of its photograph {name}, {photo.width}x{photo.height}"
            + (": width and height are swapped" if turned else ""),
            file=path,
            fix=_FIX,
        )
