"""The video tracks of an MP4 or MOV file by its header."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import BinaryIO

import numpy as np

from pipeline.io.video_header import MAX_ELEMENTS, Header, Track

FIRST = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot", b"styp")
# Bytes of a table or of metadata: a day's video has smaller ones.
MAX_TABLE = 64 << 20
# Frames of which the times are computed: two days of them.
MAX_FRAMES = 5_000_000
# Frames before the first that is shown, which the decoder needs, are no shortening.
LEAD_IN = 3


@dataclass(frozen=True)
class _Atom:
    kind: bytes
    place: int
    start: int
    end: int


@dataclass
class _Entry:
    """A track while its atoms are read.

    Attributes:
        durations: The numbers of frames, and the duration of each of them.
        edits: The durations on the movie's clock, and starts on the track's.
    """

    place: int
    number: int = 0
    handler: bytes = b""
    width: int = 0
    height: int = 0
    frames: int = 0
    clock: int = 1
    durations: list[tuple[int, ...]] = field(default_factory=list)
    edits: list[tuple[int, int]] = field(default_factory=list)


def is_mp4(start: bytes) -> bool:
    return start[4:8] in FIRST


def read_header(file: BinaryIO) -> Header:
    """Read the tracks of a movie, also of one in fragments.

    Raises:
        ValueError, struct.error: the header is damaged.
    """
    length = file.seek(0, 2)
    entries: list[_Entry] = []
    pictures: list[Track] = []
    fragments: dict[int, int] = {}
    movie_clock, end = 1, 0
    for atom in _atoms(file, 0, length):
        end = atom.end
        if atom.kind == b"moov":
            for part in _atoms(file, atom.start, atom.end):
                if part.kind == b"mvhd":
                    movie_clock = _clock(_content(file, part))
                elif part.kind == b"trak":
                    entries.append(_track(file, part))
                elif part.kind in (b"udta", b"meta") and b"covr" in _content(file, part):
                    pictures.append(Track(0, 0, 1, part.place + 4, b"free"))
        elif atom.kind == b"moof":
            for part in _atoms(file, atom.start, atom.end):
                if part.kind == b"traf":
                    number, frames = _fragment(file, part)
                    fragments[number] = fragments.get(number, 0) + frames
    tracks = [
        Track(
            entry.width,
            entry.height,
            _shown(entry, movie_clock) + fragments.get(entry.number, 0),
            entry.place + 4,
            b"free",
        )
        for entry in entries
        if entry.handler == b"vide"
    ]
    return Header(tuple(tracks), tuple(pictures), truncated=end > length)


def _atoms(file: BinaryIO, start: int, end: int) -> Iterator[_Atom]:
    at = start
    for _ in range(MAX_ELEMENTS):
        if at + 8 > end:
            return
        file.seek(at)
        head = file.read(16)
        if len(head) < 8:
            return
        size, kind = struct.unpack_from(">I4s", head)
        before = 8
        if size == 1:
            (size,), before = struct.unpack_from(">Q", head, 8), 16
        elif size == 0:
            size = end - at
        if size < before:
            return
        yield _Atom(kind, at, at + before, at + size)
        at += size


def _content(file: BinaryIO, atom: _Atom) -> bytes:
    if atom.end - atom.start > MAX_TABLE:
        raise ValueError(f"{atom.kind!r} is too large")
    file.seek(atom.start)
    return file.read(atom.end - atom.start)


def _clock(data: bytes) -> int:
    """Units a second of ``mvhd`` and ``mdhd``."""
    return max(int(struct.unpack_from(">I", data, 20 if data[0] == 1 else 12)[0]), 1)


def _track(file: BinaryIO, trak: _Atom) -> _Entry:
    entry = _Entry(trak.place)
    inside = [trak]
    while inside:
        outer = inside.pop()
        for atom in _atoms(file, outer.start, outer.end):
            if atom.kind in (b"mdia", b"minf", b"stbl", b"edts"):
                inside.append(replace(atom, end=min(atom.end, outer.end)))
            elif atom.kind == b"tkhd":
                data = _content(file, atom)
                (entry.number,) = struct.unpack_from(">I", data, 20 if data[0] == 1 else 12)
            elif atom.kind == b"mdhd":
                entry.clock = _clock(_content(file, atom))
            # Data handlers have handler atoms, too.
            elif atom.kind == b"hdlr" and outer.kind == b"mdia":
                entry.handler = _content(file, atom)[8:12]
            elif atom.kind == b"stsd":
                data = _content(file, atom)
                if len(data) >= 44:
                    entry.width, entry.height = struct.unpack_from(">HH", data, 40)
            elif atom.kind in (b"stsz", b"stz2"):
                file.seek(atom.start + 8)
                (entry.frames,) = struct.unpack(">I", file.read(4))
            elif atom.kind == b"stts":
                entry.durations = _table(_content(file, atom), "II")
            elif atom.kind == b"elst":
                data = _content(file, atom)
                rows = _table(data, "qqi" if data[0] == 1 else "iii")
                entry.edits = [(length, start) for length, start, _ in rows]
    return entry


def _table(data: bytes, kinds: str) -> list[tuple[int, ...]]:
    """The rows of a table behind a version and the number of rows.

    Args:
        kinds: The types of a row's numbers, in the letters of ``struct``.
    """
    (rows,) = struct.unpack_from(">I", data, 4)
    size = struct.calcsize(f">{kinds}")
    end = 8 + size * min(rows, (len(data) - 8) // size)
    return list(struct.iter_unpack(f">{kinds}", data[8:end]))


def _shown(entry: _Entry, movie_clock: int) -> int:
    """The number of frames that the list of edits shows."""
    segments = [(length, start) for length, start in entry.edits if start >= 0 and length > 0]
    counts, steps = np.array(entry.durations, np.int64).reshape(-1, 2).T
    if not segments or not 0 < counts.sum() <= MAX_FRAMES:
        return entry.frames
    ends = np.repeat(steps, counts).cumsum()
    times = ends - np.repeat(steps, counts)
    shown = 0
    for length, start in segments:
        stop = start + length * entry.clock / movie_clock
        shown += int(np.searchsorted(times, stop) - np.searchsorted(times, start))
    return entry.frames if shown + LEAD_IN >= entry.frames else shown


def _fragment(file: BinaryIO, traf: _Atom) -> tuple[int, int]:
    """The track of a fragment, and its number of frames."""
    number = frames = 0
    for atom in _atoms(file, traf.start, traf.end):
        if atom.kind in (b"tfhd", b"trun"):
            file.seek(atom.start + 4)
            (value,) = struct.unpack(">I", file.read(4))
            if atom.kind == b"tfhd":
                number = value
            else:
                frames += value
    return number, frames
