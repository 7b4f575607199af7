"""Video files with several streams, sound, pauses, edits and cover pictures, written by hand.

OpenCV's writer can make none of these. Frames are JPEG, sound is silence of 16 bits.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

# The movie's clock counts this many units a second.
MOVIE_CLOCK = 1000
MATRIX = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)


@dataclass(frozen=True)
class Stream:
    """A stream of a file.

    Attributes:
        samples: The frames, or the pieces of sound.
        durations: The duration of each sample in units of the stream's clock.
        size: The width and height of the frames; None for sound.
        edits: The segments of a MOV file that are shown, each with its duration on the movie's
            clock and its start on the stream's; None shows all frames.
    """

    samples: Sequence[bytes]
    durations: Sequence[int]
    clock: int
    size: tuple[int, int] | None
    edits: Sequence[tuple[int, int]] | None = None


def jpeg(size: tuple[int, int], value: int) -> bytes:
    """A JPEG picture in a single shade of grey."""
    done, data = cv2.imencode(".jpg", np.full((size[1], size[0], 3), value, np.uint8))
    assert done
    return data.tobytes()


def video(
    size: tuple[int, int],
    frames: int,
    value: int,
    pause_s: int = 0,
    edits: Sequence[tuple[int, int]] | None = None,
) -> Stream:
    """25 frames a second, each in a single shade of grey, with a pause in the middle."""
    durations = [24] * frames
    durations[frames // 2] += 600 * pause_s
    return Stream([jpeg(size, value)] * frames, durations, 600, size, edits)


def sound(seconds: int) -> Stream:
    """Silence in packets of 16 ms."""
    return Stream([bytes(256)] * (63 * seconds), [128] * (63 * seconds), 8000, None)


def interleaved(streams: Sequence[Stream]) -> list[tuple[float, int, int]]:
    """The samples in the order of time: time, number of the stream, number of the sample."""
    return sorted(
        (float(time), number, index)
        for number, stream in enumerate(streams)
        for index, time in enumerate(
            (np.cumsum(stream.durations) - stream.durations) / stream.clock
        )
    )


# --- MOV ----------------------------------------------------------------------------------


def atom(kind: bytes, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack(">I4s", 8 + len(body), kind) + body


def full(kind: bytes, *parts: bytes, flags: int = 0) -> bytes:
    return atom(kind, struct.pack(">I", flags), *parts)


def _entry(stream: Stream) -> bytes:
    start = bytes(6) + struct.pack(">H", 1)
    if stream.size is None:
        fields = struct.pack(">HHIHHHHI", 0, 0, 0, 1, 16, 0, 0, stream.clock << 16)
        return atom(b"sowt", start, fields)
    fields = struct.pack(
        ">HH4sIIHHIIIH", 0, 0, b"test", 0, 512, *stream.size, 72 << 16, 72 << 16, 0, 1
    )
    return atom(b"jpeg", start, fields, bytes(32), struct.pack(">Hh", 24, -1))


def _trak(number: int, stream: Stream, offsets: Sequence[int]) -> bytes:
    total, shown = sum(stream.durations), stream.size or (0, 0)
    duration = total * MOVIE_CLOCK // stream.clock
    header = full(
        b"tkhd",
        struct.pack(">IIIII", 0, 0, number, 0, duration),
        bytes(16),
        MATRIX,
        struct.pack(">II", shown[0] << 16, shown[1] << 16),
        flags=15,
    )
    edits = b""
    if stream.edits is not None:
        rows = [struct.pack(">IiI", *edit, 1 << 16) for edit in stream.edits]
        edits = atom(b"edts", full(b"elst", struct.pack(">I", len(rows)), *rows))
    count = struct.pack(">I", len(stream.samples))
    table = atom(
        b"stbl",
        full(b"stsd", struct.pack(">I", 1), _entry(stream)),
        full(b"stts", count, *(struct.pack(">II", 1, d) for d in stream.durations)),
        full(b"stsc", struct.pack(">IIII", 1, 1, 1, 1)),
        full(b"stsz", bytes(4), count, *(struct.pack(">I", len(s)) for s in stream.samples)),
        full(b"stco", count, *(struct.pack(">I", offset) for offset in offsets)),
    )
    media = full(b"smhd", bytes(4)) if stream.size is None else full(b"vmhd", bytes(8), flags=1)
    place = atom(b"dinf", full(b"dref", struct.pack(">I", 1), full(b"url ", flags=1)))
    handler = b"soun" if stream.size is None else b"vide"
    return atom(
        b"trak",
        header,
        edits,
        atom(
            b"mdia",
            full(b"mdhd", struct.pack(">IIIIHH", 0, 0, stream.clock, total, 0x55C4, 0)),
            full(b"hdlr", bytes(4), handler, bytes(12), b"x\0"),
            atom(b"minf", media, place, table),
        ),
    )


def write_mov(
    path: Path, streams: Sequence[Stream], cover: bytes | None = None, cover_first: bool = False
) -> Path:
    """Write a MOV file, whose header is at its end."""
    start = atom(b"ftyp", b"qt  ", bytes(4), b"qt  ")
    offsets = [[0] * len(stream.samples) for stream in streams]
    data = bytearray()
    for _, number, index in interleaved(streams):
        offsets[number][index] = len(start) + 8 + len(data)
        data += streams[number].samples[index]
    traks = [
        _trak(number, stream, of)
        for number, (stream, of) in enumerate(zip(streams, offsets, strict=True), 1)
    ]
    pictures = []
    if cover is not None:
        covers = atom(b"covr", atom(b"data", struct.pack(">II", 13, 0), cover))
        handler = full(b"hdlr", bytes(4), b"mdir", b"appl", bytes(9))
        pictures = [atom(b"udta", full(b"meta", handler, atom(b"ilst", covers)))]
    longest = max(sum(s.durations) * MOVIE_CLOCK // s.clock for s in streams)
    movie = full(
        b"mvhd",
        struct.pack(">IIIIIH", 0, 0, MOVIE_CLOCK, longest, 1 << 16, 256),
        bytes(10),
        MATRIX,
        bytes(24),
        struct.pack(">I", len(streams) + 1),
    )
    parts = [*pictures, *traks] if cover_first else [*traks, *pictures]
    path.write_bytes(start + atom(b"mdat", bytes(data)) + atom(b"moov", movie, *parts))
    return path


# --- Matroska -----------------------------------------------------------------------------


def element(name: int, *parts: bytes | int) -> bytes:
    body = b"".join(
        part if isinstance(part, bytes) else part.to_bytes(max(1, (part.bit_length() + 7) // 8))
        for part in parts
    )
    identity = name.to_bytes((name.bit_length() + 7) // 8)
    return identity + (len(body) | 1 << 56).to_bytes(8) + body


def write_mkv(path: Path, streams: Sequence[Stream], known_size: bool = True) -> Path:
    """Write a Matroska file, each frame in a cluster.

    Args:
        known_size: whether the segment has a size; files that were recorded live have none.
    """
    head = element(0x1A45DFA3, element(0x4282, b"matroska"), element(0x4287, 4), element(0x4285, 2))
    tracks = []
    for number, stream in enumerate(streams, 1):
        if stream.size is None:
            rate = element(0xB5, struct.pack(">d", stream.clock))
            kind = element(0x83, 2) + element(0x86, b"A_PCM/INT/LIT")
            kind += element(0xE1, rate, element(0x9F, 1), element(0x6264, 16))
        else:
            kind = element(0x83, 1) + element(0x86, b"V_MJPEG")
            kind += element(0xE0, element(0xB0, stream.size[0]), element(0xBA, stream.size[1]))
        tracks.append(element(0xAE, element(0xD7, number), element(0x73C5, number), kind))
    clusters = [
        element(
            0x1F43B675,
            element(0xE7, round(1000 * time)),
            element(0xA3, bytes([0x80 | number + 1, 0, 0, 0x80]), streams[number].samples[index]),
        )
        for time, number, index in interleaved(streams)
    ]
    segment = element(
        0x18538067,
        element(0x1549A966, element(0x2AD7B1, 1_000_000)),
        element(0x1654AE6B, *tracks),
        *clusters,
    )
    if not known_size:
        segment = segment[:4] + b"\x01" + b"\xff" * 7 + segment[12:]
    path.write_bytes(head + segment)
    return path


# --- AVI ----------------------------------------------------------------------------------


def chunk(kind: bytes, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return kind + struct.pack("<I", len(body)) + body + bytes(len(body) % 2)


def write_avi(path: Path, streams: Sequence[Stream]) -> Path:
    """Write an AVI file without an index. It has no times: pauses are lost."""
    headers = []
    for stream in streams:
        size, count = stream.size or (0, 0), len(stream.samples)
        if stream.size is None:
            kind, scale, rate = b"auds" + bytes(4), 1, stream.clock
            layout = struct.pack("<HHIIHH", 1, 1, stream.clock, 2 * stream.clock, 2, 16)
        else:
            kind, scale, rate = b"vidsMJPG", 1, 25
            layout = struct.pack("<IiiHH4sIiiII", 40, *size, 1, 24, b"MJPG", 0, 0, 0, 0, 0)
        sample = 2 if stream.size is None else 0
        fields = struct.pack(
            "<IHHIIIIIIII4H", 0, 0, 0, 0, scale, rate, 0, count, 0, 0, sample, *[0] * 4
        )
        headers.append(
            chunk(b"LIST", b"strl", chunk(b"strh", kind, fields), chunk(b"strf", layout))
        )
    main = struct.pack("<14I", 40_000, 0, 0, 0, 0, 0, len(streams), *[0] * 7)
    data = [
        chunk(b"%02d" % number + (b"wb" if s.size is None else b"dc"), s.samples[index])
        for _, number, index in interleaved(streams)
        for s in [streams[number]]
    ]
    path.write_bytes(
        chunk(
            b"RIFF",
            b"AVI ",
            chunk(b"LIST", b"hdrl", chunk(b"avih", main), *headers),
            chunk(b"LIST", b"movi", *data),
        )
    )
    return path
