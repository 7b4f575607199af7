"""The container format of E57 files (ASTM E2807): pages with checksums, an XML section that
describes the file, and binary sections of records.

A file consists of pages of 1024 bytes, the last four of which are the CRC-32C of the others. An
offset is physical where it counts the checksums, and logical where it does not. A compressed vector
is a binary section of packets. A data packet holds some bytes of every field of the vector's
prototype; a field's values are packed without gaps, across packets: floats as they are, integers in
the number of bits that their range needs.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import BinaryIO
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from pipeline.io.bounded_xml import parse_xml

_PAGE, _CHECKED = 1024, 1020
_HEADER = struct.Struct("<8sIIQQQQ")
_SECTION = struct.Struct("<B7xQQQ")
_VECTOR_SECTION = 1
_INDEX, _DATA, _EMPTY = 0, 1, 2
# Pages that are read at a time: 4 MiB.
_BLOCK_PAGES = 4096
# A scan takes about 4 kB.
_MAX_XML = 1 << 25
# Bytes of fields that are in memory before their records are complete.
_MAX_BUFFERED = 1 << 28
# Larger texts are no numbers.
_MAX_DIGITS = 40


class Pages:
    """The logical bytes of a file, whose checksums are verified as they are read."""

    def __init__(self, file: BinaryIO):
        """Read the header.

        Raises:
            ValueError: The file is not an E57 file, or shorter than its header says.
        """
        self._file = file
        data = file.read(_HEADER.size).ljust(_HEADER.size, b"\0")
        magic, major, _, length, xml, self._xml_length, page = _HEADER.unpack(data)
        if magic != b"ASTM-E57" or major != 1:
            raise ValueError(f"expected an E57 file, found one that begins with {magic!r}")
        if page != _PAGE:
            raise ValueError(f"expected pages of {_PAGE} bytes, found {page}")
        found = file.seek(0, 2)
        if not 0 < length <= found or length % _PAGE:
            raise ValueError(f"expected a file of {length} bytes, found {found}")
        self.size = length // _PAGE * _CHECKED
        self._first, self._block = 0, b""  # Logical bytes from an offset on.
        self._xml = self.logical(xml)

    def logical(self, physical: int) -> int:
        """The logical offset of a physical one."""
        page, rest = divmod(physical, _PAGE)
        if rest >= _CHECKED or page * _CHECKED + rest > self.size:
            raise ValueError(f"expected an offset in the file, found {physical}")
        return page * _CHECKED + rest

    def read(self, start: int, size: int) -> bytes:
        """``size`` bytes from a logical offset on.

        Raises:
            ValueError: The bytes are not in the file, or a page has another checksum.
        """
        if start < 0 or start + size > self.size:
            raise ValueError(f"expected {size} bytes at offset {start}, found the end of the file")
        parts = []
        while size:
            if not self._first <= start < self._first + len(self._block):
                self._load(start // _CHECKED)
            at = start - self._first
            parts.append(self._block[at : at + size])
            start += len(parts[-1])
            size -= len(parts[-1])
        return b"".join(parts)

    def root(self) -> Element:
        """The root element of the XML section."""
        if self._xml_length > _MAX_XML:
            raise ValueError(
                f"expected at most {_MAX_XML >> 20} MiB of XML, found {self._xml_length} bytes"
            )
        return parse_xml(self.read(self._xml, self._xml_length))

    def _load(self, page: int) -> None:
        """Read the pages from ``page`` on and compare their checksums."""
        self._file.seek(page * _PAGE)
        count = min(_BLOCK_PAGES, self.size // _CHECKED - page)
        data = self._file.read(count * _PAGE)
        if len(data) < count * _PAGE:
            raise ValueError("expected no change while the file is read, found a shorter file")
        pages = np.frombuffer(data, np.uint8).reshape(count, _PAGE)
        stored = np.ascontiguousarray(pages[:, _CHECKED:]).view(">u4")[:, 0]
        wrong = np.flatnonzero(_checksums(pages) != stored)
        if len(wrong):
            raise ValueError(f"expected intact pages, found a wrong checksum at {page + wrong[0]}")
        self._first, self._block = page * _CHECKED, pages[:, :_CHECKED].tobytes()


def _checksum_table() -> NDArray[np.uint32]:
    """CRC-32C of two bytes (RFC 3720, appendix B.4), the polynomial being reflected."""
    values = np.arange(1 << 16, dtype=np.uint32)
    for _ in range(16):
        values = values >> np.uint32(1) ^ np.where(values & 1, np.uint32(0x82F63B78), np.uint32(0))
    return values


_TABLE = _checksum_table()


def _checksums(pages: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """The checksum of each page, two bytes of all pages at a time."""
    words = np.ascontiguousarray(pages[:, :_CHECKED].view("<u2").T)
    value = np.full(len(pages), 0xFFFFFFFF, np.uint32)
    for word in words:
        value = value >> np.uint32(16) ^ _TABLE[(value ^ word) & np.uint32(0xFFFF)]
    return ~value


@dataclass(frozen=True)
class Field:
    """A number of each record.

    Attributes:
        index: The place of the field's bytes in a data packet.
        bits: The number of bits of a value; 0 if all values are ``minimum``.
        floating: Whether values are floats, otherwise they are integers above ``minimum``.
        scale, offset: The factor of an integer, and what is added to the product.
    """

    index: int
    bits: int
    floating: bool
    minimum: int = 0
    scale: float = 1.0
    offset: float = 0.0

    def values(self, data: bytes, first: int, count: int) -> NDArray[np.float64]:
        """``count`` values that begin at the bit ``first``."""
        if self.floating:
            found = np.frombuffer(data, f"<f{self.bits // 8}", count, first // 8)
            return found.astype(np.float64)
        stored = unpacked(data, first, self.bits, count)
        whole = (stored + np.uint64(self.minimum % 2**64)).view(np.int64).astype(np.float64)
        return whole * self.scale + self.offset


def unpacked(data: bytes, first: int, bits: int, count: int) -> NDArray[np.uint64]:
    """``count`` integers of ``bits`` bits each from the bit ``first`` on, low bits first."""
    if not bits:
        return np.zeros(count, np.uint64)
    begin, end = first // 8, (first + count * bits + 7) // 8
    # Zeros behind the end: nine bytes are read for each value.
    padded = np.frombuffer(data[begin:end] + bytes(9), np.uint8).astype(np.uint64)
    start = first % 8 + bits * np.arange(count)
    at, shift = start >> 3, (start & 7).astype(np.uint64)
    values = np.zeros(count, np.uint64)
    for byte in range(min(8, (bits + 14) // 8)):
        values |= padded[at + byte] << np.uint64(8 * byte)
    values >>= shift
    if bits > 57:
        high = padded[at + 8] << (np.uint64(63) - shift)
        values |= high << np.uint64(1)
    return values & np.uint64(2**bits - 1)


@dataclass(frozen=True)
class Vector:
    """A compressed vector: records of fields.

    Attributes:
        offset: The physical offset of its binary section.
        count: The number of records.
        fields: The fields that are numbers, by name.
        num_fields: The number of all fields.
    """

    offset: int
    count: int
    fields: Mapping[str, Field]
    num_fields: int

    @classmethod
    def of(cls, element: Element, space: str) -> Vector:
        """The vector that an element of the XML section describes.

        Args:
            space: "{namespace}" of E57's own names.

        Raises:
            ValueError: An attribute is missing or wrong, or there is an unknown codec.
        """
        prototype = element.find(f"{space}prototype")
        if element.get("type") != "CompressedVector" or prototype is None:
            raise ValueError("expected points in a compressed vector, found none")
        for codec in element.iterfind(f"{space}codecs/*/*"):
            if codec.tag not in (f"{space}inputs", f"{space}bitPackCodec"):
                raise ValueError(f"expected E57's bit packing, found the codec {codec.tag[:80]}")
        inner = list(prototype.iter())[1:]
        leaves = [leaf for leaf in inner if leaf.get("type") not in _CONTAINERS]
        fields = {}
        for index, leaf in enumerate(leaves):
            field = _field(index, leaf)
            if field is not None and leaf.tag.startswith(space):
                fields[leaf.tag.removeprefix(space)] = field
        offset, count = (integer(element.get(name, "")) for name in ("fileOffset", "recordCount"))
        if offset < 0 or count < 0:
            raise ValueError("expected a vector with an offset and a number of records")
        return cls(offset, count, fields, len(leaves))


_CONTAINERS = ("Structure", "Vector")


def _field(index: int, leaf: Element) -> Field | None:
    kind = leaf.get("type")
    if kind == "Float":
        return Field(index, 32 if leaf.get("precision") == "single" else 64, floating=True)
    if kind not in ("Integer", "ScaledInteger"):
        return None
    low, high = (
        integer(leaf.get(name, str(default)))
        for name, default in (("minimum", -(2**63)), ("maximum", 2**63 - 1))
    )
    if not -(2**63) <= low <= high < 2**63:
        raise ValueError(f"expected a range of integers, found {low} to {high}")
    if kind == "Integer":
        return Field(index, (high - low).bit_length(), False, low)
    scale, offset = number(leaf.get("scale", "1")), number(leaf.get("offset", "0"))
    return Field(index, (high - low).bit_length(), False, low, scale, offset)


def integer(text: str) -> int:
    """Raises: ValueError: ``text`` is no integer."""
    if len(text) > _MAX_DIGITS:
        raise ValueError("expected an integer, found a longer text")
    return int(text)


def number(text: str | None) -> float:
    """The number of an element, whose text may be left out if it is 0.

    Raises:
        ValueError: ``text`` is no finite number.
    """
    text = (text or "0").strip() or "0"
    if len(text) > _MAX_DIGITS or not math.isfinite(float(text)):
        raise ValueError(f"expected a number, found {text[:_MAX_DIGITS]!r}")
    return float(text)


def records(
    pages: Pages, vector: Vector, names: list[str], size: int
) -> Iterator[dict[str, NDArray[np.float64]]]:
    """The values of some fields, at most ``size`` records at a time.

    Raises:
        ValueError: a damaged section.
    """
    streams = {name: _Stream(vector.fields[name]) for name in names}
    packets = _data_packets(pages, vector)
    left = vector.count
    while left:
        count = min(size, left)
        while any(stream.available < count for stream in streams.values()):
            packet = next(packets, None)
            if packet is None:
                raise ValueError(f"expected {vector.count} points, found fewer")
            for stream in streams.values():
                stream.append(packet[stream.field.index])
            if sum(stream.buffered for stream in streams.values()) > _MAX_BUFFERED:
                raise ValueError("expected records, found fields of different numbers of values")
        yield {name: stream.take(count) for name, stream in streams.items()}
        left -= count


class _Stream:
    """Bytes of a field whose values have not been read yet."""

    def __init__(self, field: Field):
        self.field = field
        self.buffered = 0  # Number of bytes.
        self._parts: list[bytes] = []
        self._first = 0  # The bit of the first value.

    @property
    def available(self) -> int:
        if not self.field.bits:
            return 2**63
        return (8 * self.buffered - self._first) // self.field.bits

    def append(self, data: bytes) -> None:
        if self.field.bits:
            self._parts.append(data)
            self.buffered += len(data)

    def take(self, count: int) -> NDArray[np.float64]:
        data = b"".join(self._parts)
        values = self.field.values(data, self._first, count)
        used, self._first = divmod(self._first + count * self.field.bits, 8)
        self._parts = [data[used:]]
        self.buffered -= used
        return values


def _data_packets(pages: Pages, vector: Vector) -> Iterator[list[bytes]]:
    """The bytes of each field, packet by packet."""
    at = pages.logical(vector.offset)
    kind, length, data, _ = _SECTION.unpack(pages.read(at, _SECTION.size))
    end = at + length
    if kind != _VECTOR_SECTION or end > pages.size:
        raise ValueError(f"expected a section of points at offset {vector.offset}, found none")
    first = at + _SECTION.size
    at = pages.logical(data)
    if not first <= at <= end:
        raise ValueError(f"expected packets in their section, found the offset {data}")
    while at + 4 <= end:
        kind, _, last = struct.unpack("<BBH", pages.read(at, 4))
        packet = pages.read(at, min(last + 1, end - at))
        if kind == _DATA:
            yield _split(packet, vector.num_fields)
        elif kind not in (_INDEX, _EMPTY):
            raise ValueError(f"expected a packet at offset {at}, found the type {kind}")
        at += max(last + 1, 4)


def _split(packet: bytes, num_fields: int) -> list[bytes]:
    begin = 6 + 2 * num_fields
    if len(packet) < begin or struct.unpack_from("<H", packet, 4)[0] != num_fields:
        raise ValueError(f"expected a packet of {num_fields} fields, found another number")
    found = []
    for size in struct.unpack_from(f"<{num_fields}H", packet, 6):
        found.append(packet[begin : begin + size])
        begin += size
    if begin > len(packet):
        raise ValueError("expected the fields of a packet, found its end")
    return found
