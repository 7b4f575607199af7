"""The containers of SPZ files: one gzip stream (versions 1 to 3), or a zstd stream for each
attribute behind a header that is not compressed (version 4).

The attributes follow each other in both: positions, opacities, colours, scales, rotations, and
higher spherical harmonics. Extensions are records of a type, a length and that many bytes. Source
of the layouts: github.com/nianticlabs/spz, README.md and extensions/README.md.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from pipeline.io.bounded import MIB, opened_regular
from pipeline.runtime.machine import usable_memory
from pipeline.splats.axes import RUB, Signs

ANTIALIASED, HAS_EXTENSIONS = 1, 2
#: SH coefficients above DC by degree; splatmake's end at 3.
HIGHER = (0, 3, 8, 15, 24)
#: Niantic's readers of the versions accept up to so many Gaussians.
MAX_GAUSSIANS = {1: 10_000_000, 2: 10_000_000, 3: 10_000_000, 4: 30_000_000}

_MAGIC = 0x5053474E  # "NGSP"
# Magic, version, count, SH degree, fraction bits, flags; then 0, or in version 4 the number of
# streams and the position of their table.
_GZIP_HEADER = struct.Struct("<IIIBBBB")
_ZSTD_HEADER = struct.Struct("<IIIBBBBI12x")
_STREAM = struct.Struct("<QQ")  # Sizes: compressed, expanded.
_ZSTD_LEVEL = 12
# The extension that names the axes of a file (SPZ_ADOBE_coordinate_system).
_EXTENSION, _AXES_EXTENSION = struct.Struct("<II"), 0xADBE0003
_MAX_EXTENSIONS = 1 << 16
# Attributes may have so many times the bytes of the file; measured values are smaller, but for
# small files of equal Gaussians.
_MAX_EXPANSION, _SMALL = 200, MIB


class Header(NamedTuple):
    """The header of an SPZ file."""

    version: int
    number: int
    degree: int
    fraction_bits: int
    flags: int

    @property
    def widths(self) -> tuple[int, ...]:
        """The number of bytes of each attribute of a Gaussian."""
        position, rotation = 6 if self.version == 1 else 9, 4 if self.version >= 3 else 3
        return (position, 1, 3, 3, rotation, 3 * HIGHER[self.degree])

    @property
    def size(self) -> int:
        """The number of bytes of all attributes."""
        return self.number * sum(self.widths)


class Content(NamedTuple):
    """What an SPZ file holds.

    Attributes:
        header: The header.
        attributes: (number, width) bytes of each attribute.
        axes: The signs from the world's coordinates to the file's.
    """

    header: Header
    attributes: list[NDArray[np.uint8]]
    axes: Signs


def pack(header: Header, attributes: Iterable[Iterable[bytes]]) -> Iterator[bytes]:
    """The bytes of an SPZ file of version 3 or 4, piece by piece, without a time.

    Args:
        attributes: The bytes of each attribute, in chunks.
    """
    if header.version == 3:
        stream = zlib.compressobj(6, wbits=zlib.MAX_WBITS | 16)
        for piece in chain([_GZIP_HEADER.pack(_MAGIC, *header, 0)], *attributes):
            yield stream.compress(piece)
        yield stream.flush()
        return
    streams, table = [], b""
    for width, pieces in zip(header.widths, attributes, strict=True):
        if size := header.number * width:  # Attributes without bytes have no stream.
            compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compressobj(size=size)
            streams.append(b"".join([*map(compressor.compress, pieces), compressor.flush()]))
            table += _STREAM.pack(len(streams[-1]), size)
    yield _ZSTD_HEADER.pack(_MAGIC, *header, len(streams), _ZSTD_HEADER.size)
    yield table
    yield from streams


def unpack(data: bytes) -> Content:
    """Expand an SPZ file of version 1 to 4.

    Raises:
        ValueError: The file is not SPZ, another version, truncated, inconsistent with its header,
            larger than half of the memory when it is expanded, or has axes that are not supported.
    """
    is_zstd = data[:4] == struct.pack("<I", _MAGIC)
    header, body, extensions = (_unpack_zstd if is_zstd else _unpack_gzip)(data)
    ends = header.number * np.cumsum(header.widths)
    parts = np.split(np.frombuffer(body, np.uint8, header.size), ends[:-1])
    attributes = [
        part.reshape(header.number, width) for part, width in zip(parts, header.widths, strict=True)
    ]
    return Content(header, attributes, _axes(extensions) if extensions else RUB)


def read_header(path: Path) -> Header | None:
    """The header of an SPZ file; None for a file that cannot be read."""
    try:
        with opened_regular(path) as file:
            start = file.read(4096)
        if start[:4] != struct.pack("<I", _MAGIC):
            expander = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
            start = expander.decompress(start, _GZIP_HEADER.size)
        magic, *fields, _ = _GZIP_HEADER.unpack_from(start)
    except (OSError, zlib.error, struct.error):
        return None
    return Header(*fields) if magic == _MAGIC and fields[0] in MAX_GAUSSIANS else None


def _unpack_gzip(data: bytes) -> tuple[Header, bytes, bytes]:
    stream = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
    try:
        head = stream.decompress(data, _GZIP_HEADER.size)
        if len(head) < _GZIP_HEADER.size:
            raise ValueError(
                f"expected an SPZ header of {_GZIP_HEADER.size} bytes, found {len(head)}"
            )
        magic, *fields, _ = _GZIP_HEADER.unpack(head)
        if magic != _MAGIC:
            raise ValueError("expected an SPZ file, found another gzip file")
        header = Header(*fields)
        _check(header, (1, 2, 3), len(data))
        more = _MAX_EXTENSIONS if header.flags & HAS_EXTENSIONS else 0
        # One byte more than expected shows an excess; a malicious file could exhaust the memory.
        body = stream.decompress(stream.unconsumed_tail, header.size + more + 1)
    except zlib.error as error:
        raise ValueError(f"expected an SPZ file (gzip or zstd), cannot read it: {error}") from None
    if len(body) < header.size or len(body) > header.size + more:
        found = "more" if len(body) > header.size else str(len(body))
        raise ValueError(_mismatch(header, header.size, found))
    if not stream.eof:  # The checksum is at the end.
        raise ValueError("expected a complete gzip stream, found one without its end")
    return header, body, body[header.size :]


def _unpack_zstd(data: bytes) -> tuple[Header, bytes, bytes]:
    if len(data) < _ZSTD_HEADER.size:
        raise ValueError(f"expected an SPZ header of {_ZSTD_HEADER.size} bytes, found {len(data)}")
    _, *fields, streams, table = _ZSTD_HEADER.unpack_from(data)
    header = Header(*fields)
    _check(header, (4,), len(data))
    sizes = [header.number * width for width in header.widths if header.number * width]
    extensions, start = table - _ZSTD_HEADER.size, table + streams * _STREAM.size
    if streams != len(sizes) or not 0 <= extensions <= _MAX_EXTENSIONS or start > len(data):
        raise ValueError(
            f"expected a table of {len(sizes)} streams within {_MAX_EXTENSIONS} bytes of the "
            f"header, found one of {streams} at byte {table} of {len(data)}"
        )
    parts = []
    for size, (packed, found) in zip(sizes, _STREAM.iter_unpack(data[table:start]), strict=True):
        if found != size:
            raise ValueError(_mismatch(header, size, str(found)))
        if packed > len(data) - start:
            raise ValueError(f"expected a stream of {packed} bytes, found {len(data) - start}")
        parts.append(_expand(memoryview(data)[start : start + packed], size))
        if len(parts[-1]) != size:
            raise ValueError(_mismatch(header, size, str(len(parts[-1]))))
        start += packed
    if start != len(data):
        raise ValueError(f"expected a file of {start} bytes, found {len(data)}")
    known = data[_ZSTD_HEADER.size : table] if header.flags & HAS_EXTENSIONS else b""
    return header, b"".join(parts), known


def _expand(packed: memoryview, size: int) -> bytes:
    """Up to ``size + 1`` bytes of a zstd stream."""
    # The reader allocates the window that a stream names, which need not exceed the content.
    window = max(size, _SMALL)
    try:
        expander = zstandard.ZstdDecompressor(max_window_size=1 << (window - 1).bit_length())
        with expander.stream_reader(packed, read_across_frames=True) as reader:
            return reader.read(size + 1)
    except zstandard.ZstdError as error:
        raise ValueError(f"expected a zstd stream of {size} bytes, found none: {error}") from None


def _check(header: Header, versions: tuple[int, ...], size: int) -> None:
    """Raises: ValueError: a header that is not of ``versions``, or promises more than a file of
    ``size`` bytes can hold or than the memory allows."""
    version, number, degree, bits, _ = header
    if version not in versions:
        raise ValueError(f"expected SPZ version 1 to 4, found version {version}")
    limit = MAX_GAUSSIANS[version]
    if number > limit or degree >= len(HIGHER) or bits > 24:
        raise ValueError(
            f"expected up to {limit} Gaussians, SH degree 0 to 4 and 0 to 24 fraction bits, found "
            f"{number}, {degree} and {bits}"
        )
    if header.size > max(_MAX_EXPANSION * size, _SMALL):
        raise ValueError(
            f"expected Gaussians of at most {_MAX_EXPANSION} times the file's size, found "
            f"{header.size} bytes of them"
        )
    memory = usable_memory() // 2
    if 4 * header.size > memory:  # As float32.
        raise ValueError(
            f"expected at most {memory // MIB} MiB of Gaussians (half of the memory), found "
            f"{4 * header.size // MIB} MiB"
        )


def _mismatch(header: Header, expected: int, found: str) -> str:
    return f"expected {expected} bytes of {header.number} Gaussians, found {found}"


def _axes(extensions: bytes) -> Signs:
    """The signs from the world's coordinates to those of a file with ``extensions``."""
    start = 0
    while start + _EXTENSION.size <= len(extensions):
        kind, length = _EXTENSION.unpack_from(extensions, start)
        start += _EXTENSION.size
        if kind == _AXES_EXTENSION and length == 4 and start + 4 <= len(extensions):
            code = int.from_bytes(extensions[start : start + 4], "little")
            if code > 8:
                raise ValueError(
                    "expected axes that point along or against right, up and back (code 0 to 8), "
                    f"found code {code}"
                )
            # Bit 0 is set if x points right, bit 1 if y points up, bit 2 if z points forward.
            right, up, forward = ((code - 1) >> bit & 1 for bit in range(3))
            return (2 * right - 1, 1 - 2 * up, 2 * forward - 1) if code else RUB
        start += length
    return RUB
