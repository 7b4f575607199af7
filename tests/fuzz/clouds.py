"""Point clouds."""

from __future__ import annotations

import io
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.io.clouds.e57_points import read_e57
from pipeline.io.clouds.las_points import count_las, read_las
from pipeline.io.clouds.text_points import read_text
from tests.fuzz.reader import Files, Reader, of_file
from tests.io.clouds.written import write_e57

XYZ = b"# x y z r g b\n" + b"".join(b"%d.5 %d 1e2 255 0 %d\n" % (i, -i, i) for i in range(20))
# An E57 file consists of pages, each of which ends with a checksum of its content.
PAGE, CHECKSUM = 1024, 4


def las_seeds() -> Sequence[Files]:
    import laspy

    cloud = laspy.create(point_format=3, file_version="1.2")
    cloud.x, cloud.y, cloud.z = np.arange(20.0), np.arange(20.0) / 2, np.ones(20)
    stream = io.BytesIO()
    cloud.write(stream)
    return [{"points.las": stream.getvalue()}]


def read_las_points(file: Path) -> object:
    count_las(file)
    return list(read_las(file))


def e57_seeds() -> Sequence[Files]:
    xyz = np.random.default_rng(0).normal(size=(20, 3))
    colours = np.random.default_rng(0).integers(0, 256, (20, 3), np.uint8)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "points.e57"
        found = []
        for rgb in (None, colours):
            write_e57(file, xyz, rgb, shift=np.ones(3))
            found.append({file.name: _with_one_guid(file.read_bytes())})
            file.unlink()
        return found


def _with_one_guid(data: bytes) -> bytes:
    """The file with the same identifiers each time, which its writer draws."""
    guid = re.compile(rb"\{[0-9a-fA-F]{8}(-[0-9a-fA-F]{4}){3}-[0-9a-fA-F]{12}\}")
    fixed = b"{00000000-0000-0000-0000-000000000000}"
    return pack_e57(guid.sub(fixed, unpack_e57(data)))


def unpack_e57(data: bytes) -> bytes:
    """The pages without their checksums."""
    return b"".join(data[at : at + PAGE - CHECKSUM] for at in range(0, len(data), PAGE))


def pack_e57(data: bytes) -> bytes:
    size = PAGE - CHECKSUM
    pages = [data[at : at + size].ljust(size, b"\0") for at in range(0, len(data), size)]
    return b"".join(page + _crc32c(page).to_bytes(CHECKSUM, "big") for page in pages)


def _crc32c_table() -> list[int]:
    """Castagnoli's polynomial, reflected (RFC 3720)."""
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return table


_TABLE = _crc32c_table()


def _crc32c(data: bytes) -> int:
    value = 0xFFFFFFFF
    for byte in data:
        value = value >> 8 ^ _TABLE[(value ^ byte) & 0xFF]
    return value ^ 0xFFFFFFFF


CLOUDS: dict[str, Reader] = {
    "xyz": Reader(lambda: [{"points.xyz": XYZ}], of_file(lambda file: list(read_text(file)))),
    "las": Reader(las_seeds, of_file(read_las_points), weight=0.3),
    "e57": Reader(
        e57_seeds, of_file(lambda file: list(read_e57(file))), unpack_e57, pack_e57, weight=0.3
    ),
}
