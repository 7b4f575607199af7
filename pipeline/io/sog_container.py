"""The container of SOG files, version 2: ``meta.json`` and images, in a zip archive without
compression (``.sog``) or as files of a folder.

Each image is a lossless WebP with the bytes of one attribute: Gaussian i is pixel i in reading
order. Source of the layout: developer.playcanvas.com, "The SOG Format".
"""

from __future__ import annotations

import io
import os
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from pipeline.io.bounded import MIB, opened_bounded, read_bounded
from pipeline.io.splat_codec import FIX
from pipeline.runtime.atomic import write_bytes
from pipeline.runtime.machine import usable_memory

# ``decode_image`` takes the place of PIL's limit.
Image.MAX_IMAGE_PIXELS = None

META = "meta.json"
#: The number of coefficients above degree 0 by degree.
HIGHER = (0, 3, 8, 15)
#: The images have so many centroids of the palette in a row.
CENTROIDS_PER_ROW = 64
#: Positions beyond exp(this) overflow.
_MAX_LOG = 80.0
_MAX_META = MIB
# Gaussians may take so many times the bytes of the file; measured values are smaller, but for small
# files of equal Gaussians.
_MAX_EXPANSION, _SMALL = 200, 16 * MIB
_MAX_MEMBERS = 100
# The format allows images of other formats with 8 bits. Images of few Gaussians may be padded.
_FORMATS, _SLACK = ("WEBP", "PNG"), 1 << 16
# The effort of the encoder: 4 takes a third of the time of 6, and 1 % more bytes.
_METHOD, _QUALITY = 4, 70

Bytes = NDArray[np.uint8]
# A plain name: a file cannot name one outside of its folder or archive.
_Name = Annotated[str, StringConstraints(pattern=r"^\w[\w.\-]{0,99}$")]
_Codebook = Annotated[tuple[float, ...], Field(min_length=1, max_length=256)]
_Logs = tuple[
    Annotated[float, Field(ge=-_MAX_LOG, le=_MAX_LOG)],
    Annotated[float, Field(ge=-_MAX_LOG, le=_MAX_LOG)],
    Annotated[float, Field(ge=-_MAX_LOG, le=_MAX_LOG)],
]


class _Part(BaseModel):
    # Other programs add fields.
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Means(_Part):
    """The range of the positions' signed logarithms, and the images of their low and high bytes."""

    mins: _Logs
    maxs: _Logs
    files: tuple[_Name, _Name]


class Coded(_Part):
    """An image of indices into a codebook."""

    codebook: _Codebook
    files: tuple[_Name]


class Quats(_Part):
    """The image of the rotations."""

    files: tuple[_Name]


class Harmonics(_Part):
    """The palette of spherical harmonics: images of its centroids and of each Gaussian's index."""

    count: int = Field(ge=1, le=1 << 16)
    bands: int = Field(ge=1, le=3)
    codebook: _Codebook
    files: tuple[_Name, _Name]


class Asset(_Part):
    """The program that wrote the file."""

    generator: str


class Meta(_Part):
    """``meta.json``."""

    version: Literal[2]
    asset: Asset | None = None
    count: int = Field(ge=1)
    antialias: bool = False
    means: Means
    scales: Coded
    quats: Quats
    sh0: Coded
    shN: Harmonics | None = None

    @property
    def degree(self) -> int:
        """The degree of the spherical harmonics."""
        return 0 if self.shN is None else self.shN.bands

    @property
    def files(self) -> list[str]:
        """The names of the images."""
        parts = (self.means, self.scales, self.quats, self.sh0, self.shN)
        return [name for part in parts if part is not None for name in part.files]

    @property
    def size(self) -> int:
        """The number of bytes of the Gaussians in memory."""
        return self.count * 4 * (3 + 3 + 4 + 1 + 3 * (1 + HIGHER[self.degree]))


def pack(files: Mapping[str, bytes]) -> bytes:
    """A zip archive of the files without compression and dates: the same files, the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return buffer.getvalue()


def write_folder(meta: Path, files: Mapping[str, bytes]) -> None:
    """Write the files beside ``meta``, and the file ``meta.json`` as the last, each atomically."""
    for name, content in files.items():
        if name != META:
            write_bytes(meta.with_name(name), content)
    write_bytes(meta, files[META])


def encode_image(pixels: Bytes) -> bytes:
    """A lossless WebP of (height, width, 4) bytes, which keeps the colours of every pixel."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(
        buffer, "WEBP", lossless=True, exact=True, method=_METHOD, quality=_QUALITY
    )
    return buffer.getvalue()


def read_files(path: Path) -> tuple[Meta, dict[str, bytes]]:
    """The content of ``meta.json``, and the images that it names by name.

    Args:
        path: The archive, or the file ``meta.json`` of a folder.

    Raises:
        UserError: A file cannot be read, or is larger than half of the memory.
        ValueError: The content is not SOG version 2, or has more Gaussians than fit into memory.
    """
    if path.name.lower() == META:
        meta = _meta(read_bounded(path, _MAX_META, fix=FIX))
        files = {name: read_bounded(path.with_name(name), fix=FIX) for name in meta.files}
    else:
        files = _members(path)
        meta = _meta(files.get(META, b""))
        if missing := [name for name in meta.files if name not in files]:
            raise ValueError(f"expected the file {missing[0]} in the archive, found none")
    size = sum(len(files[name]) for name in meta.files)
    if meta.size > max(_SMALL, min(_MAX_EXPANSION * size, usable_memory() // 2)):
        raise ValueError(
            f"expected at most {_MAX_EXPANSION} times the bytes of the images ({size}) and half of "
            f"the memory, found {meta.count} Gaussians"
        )
    return meta, files


def decode_image(data: bytes, name: str, least: int, width: int | None = None) -> Bytes:
    """(P, 4) bytes of the pixels of an image in reading order.

    Args:
        name: The name of the image in errors.
        least: The least number of pixels. An image of more than twice as many is refused.
        width: The width of the image; None for any.

    Raises:
        ValueError: The file is damaged, or not such an image.
    """
    try:
        with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
            pixels = image.width * image.height
            if not least <= pixels <= 2 * least + _SLACK or image.width != (width or image.width):
                raise ValueError(
                    f"{name}: expected an image of {least} pixels"
                    f"{f' in rows of {width}' if width else ''}, found {image.width} x "
                    f"{image.height}"
                )
            if image.mode not in ("RGB", "RGBA"):
                raise ValueError(f"{name}: expected a colour image of 8 bits, found {image.mode}")
            return np.asarray(image.convert("RGBA")).reshape(-1, 4)
    # SyntaxError: what PIL raises for some damaged PNG files.
    except (OSError, SyntaxError, EOFError, struct.error) as error:
        raise ValueError(f"{name}: expected an image (WebP): {error}") from None


def _meta(text: bytes) -> Meta:
    try:
        return Meta.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        what = f"expected the {META} of SOG version 2, found {where or 'text'}: {first['msg']}"
        raise ValueError(what[:300]) from None


def _members(path: Path) -> dict[str, bytes]:
    """The files of an archive, which have at most the archive's size together."""
    try:
        with opened_bounded(path, fix=FIX) as file, zipfile.ZipFile(file) as archive:
            size = os.fstat(file.fileno()).st_size
            members = archive.infolist()
            if len(members) > _MAX_MEMBERS or sum(m.file_size for m in members) > size + MIB:
                raise ValueError(
                    f"expected at most {_MAX_MEMBERS} files without compression, found "
                    f"{len(members)} files larger than the archive"
                )
            # zipfile stops at the size that the member's entry gives.
            return {member.filename: archive.read(member) for member in members}
    # RuntimeError: encrypted; NotImplementedError: an unknown compression.
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise ValueError(f"expected a SOG file (a zip archive): {error}") from None
