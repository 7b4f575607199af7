"""Points of LAS and LAZ files (ASPRS LAS 1.0 to 1.4), by laspy and lazrs.

Headers are read here: importing laspy takes long, and its reader trusts the number of points.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from pipeline.io.bounded import opened_regular
from pipeline.io.clouds.values import CHUNK_POINTS, Chunk, Chunks, damaged, stacked

# Compression to a fraction of a byte a point happens in artificial files only.
_MAX_POINTS_PER_BYTE = 4
# Reading more takes hours.
_MAX_POINTS = 20_000_000_000
# Offsets in the public header block of LAS 1.4.
_VERSION, _HEADER_SIZE, _DATA_OFFSET, _FORMAT, _RECORD = 24, 94, 96, 104, 105
_LEGACY_COUNT, _EXTENDED, _COUNT, _HEADER = 107, 235, 247, 375
# Bytes of the headers of variable length records.
_RECORD_HEADER, _EXTENDED_HEADER = 54, 60


def count_las(path: Path) -> int:
    """Number of points according to the header.

    Raises:
        UserError: The file is not LAS or LAZ, or its header claims more points than the file can
            hold.
    """
    with opened_regular(path) as file:
        header = file.read(_HEADER)
        size = file.seek(0, 2)
    if header[:4] != b"LASF" or len(header) < 227:
        begin = header[:4]
        raise damaged(path, f"expected a LAS or LAZ file, found one that begins with {begin!r}")
    _check_records(path, header, size)
    (offset,) = struct.unpack_from("<I", header, _DATA_OFFSET)
    (record,) = struct.unpack_from("<H", header, _RECORD)
    (count,) = struct.unpack_from("<I", header, _LEGACY_COUNT)
    if _is_1_4(header):
        (count,) = struct.unpack_from("<Q", header, _COUNT)
    body = max(0, size - offset)
    compressed = bool(header[_FORMAT] & 0x80)
    room = body * _MAX_POINTS_PER_BYTE if compressed else body // max(record, 1)
    if count > min(room, _MAX_POINTS):
        what = f"expected at most {min(room, _MAX_POINTS)} points in a file of this size"
        raise damaged(path, f"{what}, found {count} in its header")
    return int(count)


def _is_1_4(header: bytes) -> bool:
    return header[_VERSION] == 1 and header[_VERSION + 1] >= 4 and len(header) >= _HEADER


def _check_records(path: Path, header: bytes, size: int) -> None:
    """Check the numbers of variable length records, before and after the points, which laspy reads
    one by one."""
    (length,) = struct.unpack_from("<H", header, _HEADER_SIZE)
    offset, number = struct.unpack_from("<II", header, _DATA_OFFSET)
    found = [(length, offset, number, _RECORD_HEADER)]
    if _is_1_4(header):
        start, number = struct.unpack_from("<QI", header, _EXTENDED)
        found.append((start if number else 0, size, number, _EXTENDED_HEADER))
    for first, last, number, least in found:
        if not (first <= last <= size and number * least <= last - first):
            raise damaged(path, f"expected variable length records in the file, found {number}")


def read_las(path: Path) -> Chunks:
    """The points of a LAS or LAZ file; runs native code that may crash on damaged files.

    Raises:
        UserError: a damaged file.
    """
    import laspy

    count_las(path)
    try:
        # Not whatever other decoder is installed: its errors are of other kinds.
        with laspy.open(path, laz_backend=laspy.LazBackend.LazrsParallel) as reader:
            for points in reader.chunk_iterator(CHUNK_POINTS):
                xyz = stacked([points.x, points.y, points.z], np.float64)
                if "red" not in set(points.point_format.dimension_names):
                    yield Chunk(xyz)
                    continue
                colour = stacked([points.red, points.green, points.blue], np.float32)
                # 16 bits by the standard; files with 8 bits are common.
                yield Chunk(xyz, colour)
    except (
        *(laspy.LaspyException, ValueError, OverflowError, EOFError, RuntimeError),
        *(struct.error, KeyError, IndexError),
    ) as error:
        raise damaged(path, f"the points cannot be read: {str(error)[:200]}") from None
