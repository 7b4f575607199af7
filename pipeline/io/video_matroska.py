"""The video tracks of a Matroska or WebM file: sizes by its header, frames by its blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import BinaryIO

from pipeline.io.video_header import MAX_ELEMENTS, Header, Track

EBML, SEGMENT, CLUSTER, BLOCK_GROUP = 0x1A45DFA3, 0x18538067, 0x1F43B675, 0xA0
TRACKS, TRACK, VIDEO = 0x1654AE6B, 0xAE, 0xE0
NUMBER, TYPE, WIDTH, HEIGHT = 0xD7, 0x83, 0xB0, 0xBA
SIMPLE_BLOCK, BLOCK = 0xA3, 0xA1
# Elements whose children are read.
ENTERED = {SEGMENT, CLUSTER, BLOCK_GROUP, TRACKS, TRACK, VIDEO}
IS_VIDEO = 1
# A type of track that FFmpeg ignores.
CONTROL = 0x20


@dataclass
class _Entry:
    number: int = 0
    type: int = 0
    place: int = 0
    width: int = 0
    height: int = 0
    frames: int = 0


def is_matroska(start: bytes) -> bool:
    return start[:4] == EBML.to_bytes(4, "big")


def read_header(file: BinaryIO) -> Header:
    """Read the tracks, and count the blocks of each.

    Raises:
        ValueError: the file is damaged in its header.
    """
    length = file.seek(0, 2)
    file.seek(0)
    entries: list[_Entry] = []
    blocks: dict[int, int] = {}
    truncated, counted = False, True
    at = 0
    for _ in range(MAX_ELEMENTS):
        file.seek(at)
        head = file.read(20)
        if len(head) < 2:
            break
        name, used = _number(head, 0, keep_marker=True)
        size, after = _number(head, used)
        unknown = size == (1 << 7 * (after - used)) - 1
        start = at + after
        if name in ENTERED:
            truncated |= name == SEGMENT and not unknown and start + size > length
            if name == TRACK:
                entries.append(_Entry())
            at = start
            continue
        if name in (SIMPLE_BLOCK, BLOCK):
            track, _ = _number(head, after)
            blocks[track] = blocks.get(track, 0) + 1
        elif entries and name in (NUMBER, TYPE, WIDTH, HEIGHT) and size <= 8:
            value = int.from_bytes(head[after : after + size], "big")
            if name == NUMBER:
                entries[-1].number = value
            elif name == TYPE:
                entries[-1].type, entries[-1].place = value, start + size - 1
            elif name == WIDTH:
                entries[-1].width = value
            else:
                entries[-1].height = value
        if unknown:
            raise ValueError("an element of unknown size")
        at = start + size
    else:
        counted = False
    tracks = [
        Track(
            e.width,
            e.height,
            blocks.get(e.number, 0) if counted else None,
            e.place,
            bytes([CONTROL]),
        )
        for e in entries
        if e.type == IS_VIDEO
    ]
    return Header(tuple(tracks), truncated=truncated)


def _number(data: bytes, at: int, keep_marker: bool = False) -> tuple[int, int]:
    """A number of variable length, and the position behind it."""
    if at >= len(data) or data[at] == 0:
        raise ValueError("expected a number of at most 8 bytes")
    bytes_used = 9 - data[at].bit_length()
    value = int.from_bytes(data[at : at + bytes_used], "big")
    if not keep_marker:
        value &= (1 << 7 * bytes_used) - 1
    return value, at + bytes_used
