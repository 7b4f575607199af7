"""The video tracks of an AVI file by its header."""

from __future__ import annotations

import struct
from typing import BinaryIO

from pipeline.io.video_header import Header, Track

# Bytes of the list of headers, which holds no frames.
MAX_LIST = 16 << 20


def is_avi(start: bytes) -> bool:
    return start[:4] == b"RIFF" and start[8:12] == b"AVI "


def read_header(file: BinaryIO) -> Header:
    """Read the streams of the first list of headers.

    Raises:
        ValueError: The file has no such list.
    """
    length = file.seek(0, 2)
    file.seek(4)
    declared = 8 + struct.unpack("<I", file.read(4))[0]
    at = 12
    while at + 12 <= length:
        file.seek(at)
        kind, size, name = struct.unpack("<4sI4s", file.read(12))
        if kind == b"LIST" and name == b"hdrl":
            tracks = _tracks(file.read(min(size, MAX_LIST)), at + 12)
            return Header(tracks, truncated=declared > length)
        at += 8 + size + size % 2
    raise ValueError("no list of headers")


def _tracks(data: bytes, offset: int) -> tuple[Track, ...]:
    """The video streams of a list of headers that begins at ``offset`` of the file."""
    found: list[Track] = []
    at, stream = 0, None
    while at + 8 <= len(data):
        kind, size = struct.unpack_from("<4sI", data, at)
        if kind == b"LIST":
            at += 12  # Its chunks follow.
            continue
        if kind == b"strh":
            stream = at + 8
        elif kind == b"strf" and stream is not None and data[stream : stream + 4] == b"vids":
            # A negative height is that of a picture that is stored from the top.
            width, height = struct.unpack_from("<ii", data, at + 12)
            (frames,) = struct.unpack_from("<I", data, stream + 32)
            found.append(Track(abs(width), abs(height), frames or None, offset + stream, b"dats"))
        at += 8 + size + size % 2
    return tuple(found)
