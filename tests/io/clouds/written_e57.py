"""E57 files of any layout: by the reference library (pye57), and put together byte by byte."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

PAGE, CHECKSUM = 1024, 4
_INSIDE = PAGE - CHECKSUM
Values = NDArray[np.float64]


@dataclass(frozen=True)
class Column:
    """The values of a field, and how they are stored.

    Attributes:
        kind: "single" or "double" floats, or "integer"; "scaled" has a ``scale`` and an ``offset``.
        low, high: The range of the stored integers.
    """

    values: Values
    kind: str = "double"
    low: int = 0
    high: int = 0
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Scan:
    columns: Mapping[str, Column]
    rotation: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
    translation: Sequence[float] = (0.0, 0.0, 0.0)
    red_limit: float | None = None
    size: int = 1000
    """Records that are handed to the library at a time."""


def write_scans(path: Path, scans: Sequence[Scan]) -> None:
    """Write a file with the reference library."""
    from pye57 import libe57

    file = libe57.ImageFile(str(path), "w")
    file.extensionsAdd("", libe57.E57_V1_0_URI)
    root = file.root()
    root.set("formatName", libe57.StringNode(file, "ASTM E57 3D Imaging Data File"))
    root.set("versionMajor", libe57.IntegerNode(file, 1))
    root.set("versionMinor", libe57.IntegerNode(file, 0))
    data = libe57.VectorNode(file, True)
    root.set("data3D", data)
    for scan in scans:
        _append(file, data, scan)
    file.close()


def _append(file: Any, data: Any, scan: Scan) -> None:
    from pye57 import libe57

    node, pose = libe57.StructureNode(file), libe57.StructureNode(file)
    for name, axes, numbers in (
        ("rotation", "wxyz", scan.rotation),
        ("translation", "xyz", scan.translation),
    ):
        part = libe57.StructureNode(file)
        for axis, number in zip(axes, numbers, strict=True):
            part.set(axis, libe57.FloatNode(file, float(number)))
        pose.set(name, part)
    node.set("pose", pose)
    if scan.red_limit is not None:
        limits = libe57.StructureNode(file)
        limits.set("colorRedMaximum", libe57.FloatNode(file, scan.red_limit))
        node.set("colorLimits", limits)
    prototype, codecs = libe57.StructureNode(file), libe57.VectorNode(file, True)
    buffers, arrays = libe57.VectorSourceDestBuffer(), {}
    for name, column in scan.columns.items():
        prototype.set(name, _node(file, column))
        arrays[name] = np.zeros(scan.size)
        buffers.append(libe57.SourceDestBuffer(file, name, arrays[name], scan.size, True, True))
    points = libe57.CompressedVectorNode(file, prototype, codecs)
    node.set("points", points)
    data.append(node)
    writer = points.writer(buffers)
    count = len(next(iter(scan.columns.values())).values)
    for start in range(0, count, scan.size):
        size = min(scan.size, count - start)
        for name, column in scan.columns.items():
            arrays[name][:size] = column.values[start : start + size]
        writer.write(size)
    writer.close()


def _node(file: Any, column: Column) -> Any:
    from pye57 import libe57

    match column.kind:
        case "single":
            return libe57.FloatNode(file, 0.0, libe57.E57_SINGLE)
        case "double":
            return libe57.FloatNode(file, 0.0, libe57.E57_DOUBLE)
        case "integer":
            return libe57.IntegerNode(file, column.low, column.low, column.high)
    return libe57.ScaledIntegerNode(
        file, column.low, column.low, column.high, column.scale, column.offset
    )


def assembled(xml: bytes, section: bytes = b"") -> bytes:
    """A file with this XML, whose binary section, if there is one, is at the offset 48."""
    data = bytes(48) + section
    data += bytes(-len(data) % 4)
    page, rest = divmod(len(data), _INSIDE)
    at = page * PAGE + rest
    data += xml
    whole = -(-len(data) // _INSIDE) * PAGE
    header = struct.pack("<8sIIQQQQ", b"ASTM-E57", 1, 0, whole, at, len(xml), PAGE)
    return pack_e57(header + data[48:])


def points_xml(prototype: str, count: int, offset: int = 48, scans: int = 1) -> bytes:
    """The XML of scans that have the same points."""
    scan = (
        f'<vectorChild type="Structure"><points type="CompressedVector" fileOffset="{offset}" '
        f'recordCount="{count}"><prototype type="Structure">{prototype}</prototype>'
        '<codecs type="Vector"/></points></vectorChild>'
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?><e57Root type="Structure" '
        'xmlns="http://www.astm.org/COMMIT/E57/2010-e57-v1.0">'
        f'<data3D type="Vector">{scan * scans}</data3D></e57Root>'
    ).encode()


def section(packets: bytes, *, first: int = 80, length: int | None = None) -> bytes:
    """A compressed vector's section with these packets, which begins at the offset 48."""
    length = 32 + len(packets) if length is None else length
    return struct.pack("<B7xQQQ", 1, length, first, 0) + packets


def data_packet(*fields: bytes) -> bytes:
    body = struct.pack(f"<{len(fields)}H", *map(len, fields)) + b"".join(fields)
    body += bytes(-(6 + len(body)) % 4)
    return struct.pack("<BBHH", 1, 0, 5 + len(body), len(fields)) + body


def unpack_e57(data: bytes) -> bytes:
    """The pages without their checksums."""
    return b"".join(data[at : at + _INSIDE] for at in range(0, len(data), PAGE))


def pack_e57(data: bytes) -> bytes:
    """The pages with checksums: CRC-32C (RFC 3720), the highest byte first."""
    content = np.frombuffer(data + bytes(-len(data) % _INSIDE), np.uint8).reshape(-1, _INSIDE)
    value = np.full(len(content), 0xFFFFFFFF, np.uint32)
    for column in content.T:
        value = value >> np.uint32(8) ^ _TABLE[(value ^ column) & np.uint32(0xFF)]
    checksums = (~value).astype(">u4").view(np.uint8).reshape(-1, CHECKSUM)
    return np.concatenate([content, checksums], axis=1).tobytes()


def _crc32c_table() -> NDArray[np.uint32]:
    """Castagnoli's polynomial, reflected."""
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return np.array(table, np.uint32)


_TABLE = _crc32c_table()
