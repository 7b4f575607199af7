"""The number of video tracks of MPEG transport streams (.mts, .m2ts) and program streams (.mpg).

Source: ISO/IEC 13818-1. The sizes of pictures are in the coded frames, which are not read.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO

from pipeline.io.video_header import Header, Track

# Bytes from the start of the file in which tracks are searched: several seconds of video.
SEARCHED = 8 << 20
SYNC, PACKET = 0x47, 188
# Lengths of packets, and the bytes before each of them: cameras store a time there.
LAYOUTS = ((188, 0), (192, 4), (204, 0))
PACK, SYSTEM_END = 0xBA, 0xB9
# Types of streams in a program's map: MPEG-1, MPEG-2, MPEG-4, H.264, H.265, H.266, VC-1.
VIDEO_TYPES = frozenset({0x01, 0x02, 0x10, 0x1B, 0x24, 0x33, 0xEA})
VIDEO_IDS = range(0xE0, 0xF0)


def is_mpeg(start: bytes) -> bool:
    """Whether a file that begins with these bytes may be a transport or program stream."""
    return start[:4] == bytes([0, 0, 1, PACK]) or SYNC in (start[:1] + start[4:5])


def read_header(file: BinaryIO) -> Header:
    """Read the numbers of the video tracks at the start of the file.

    Raises:
        ValueError: The file is not a transport or program stream.
    """
    file.seek(0)
    data = file.read(SEARCHED)
    if data[:4] == bytes([0, 0, 1, PACK]):
        places = _of_program_stream(data)
    else:
        places = _of_transport_stream(data)
    return Header(tuple(Track(0, 0, None, place, b"") for place in places))


def _of_program_stream(data: bytes) -> list[int]:
    """The place of the first packet of each video stream."""
    found: dict[int, int] = {}
    at = 0
    while at + 14 <= len(data) and data[at : at + 3] == b"\0\0\1":
        kind = data[at + 3]
        if kind in VIDEO_IDS:
            found.setdefault(kind, at)
        if kind == SYSTEM_END:
            at += 4
        elif kind == PACK:
            is_mpeg2 = data[at + 4] >> 6 == 1
            at += 14 + (data[at + 13] & 7) if is_mpeg2 else 12
        else:
            at += 6 + int.from_bytes(data[at + 4 : at + 6], "big")
    return sorted(found.values())


def _of_transport_stream(data: bytes) -> list[int]:
    """The place of each video stream in the maps of programs."""
    size, before = next(
        (
            (size, before)
            for size, before in LAYOUTS
            if len(data) >= 3 * size and all(data[before + i * size] == SYNC for i in range(3))
        ),
        (0, 0),
    )
    if not size:
        raise ValueError("expected packets that begin with a synchronisation byte")
    maps: set[int] = set()
    found: dict[int, int] = {}
    for start in range(before, len(data) - PACKET + 1, size):
        number = int.from_bytes(data[start + 1 : start + 3], "big")
        if not number & 0x4000 or (number & 0x1FFF not in maps and number & 0x1FFF):
            continue
        section = _section(data[start : start + PACKET])
        if section is None:
            continue
        at, table = section
        if number & 0x1FFF == 0:
            maps |= {
                int.from_bytes(table[i + 2 : i + 4], "big") & 0x1FFF
                for i in range(8, len(table) - 7, 4)
            }
        else:
            for place, kind, stream in _streams(table):
                if kind in VIDEO_TYPES:
                    found.setdefault(stream, start + at + place)
    return sorted(found.values())


def _section(packet: bytes) -> tuple[int, bytes] | None:
    """The place and the bytes of the table that begins in a packet, as far as it is in it."""
    at = 4 + (1 + packet[4] if packet[3] & 0x20 else 0)
    if at >= PACKET:
        return None
    at += 1 + packet[at]
    length = 3 + (int.from_bytes(packet[at + 1 : at + 3], "big") & 0xFFF)
    table = packet[at : at + length]
    return (at, table) if len(table) > 12 else None


def _streams(table: bytes) -> Iterator[tuple[int, int, int]]:
    """Place, type and number of each stream in a program's map."""
    at = 12 + (int.from_bytes(table[10:12], "big") & 0xFFF)
    while at + 5 <= len(table) - 4:
        yield at, table[at], int.from_bytes(table[at + 1 : at + 3], "big") & 0x1FFF
        at += 5 + (int.from_bytes(table[at + 3 : at + 5], "big") & 0xFFF)
