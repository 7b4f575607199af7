"""Small or endless files that would take much time or memory if a reader trusted them."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

from tests.fuzz.reader import Reader

SIZE = 1 << 18
"""Bytes of the files that are made, and of the content that packs into less."""
_NUMBER = re.compile(rb"-?\d+(\.\d+)?(e[-+]?\d+)?")

Bomb = Callable[[Reader, bytes], bytes]


def _of(unit: bytes) -> bytes:
    return unit * (SIZE // len(unit))


def nested(opening: bytes) -> Bomb:
    """The file with deep nesting in its middle, which is where values are."""

    def make(reader: Reader, data: bytes) -> bytes:
        half = data.find(opening[:1], len(data) // 3)
        at = half if half > 0 else len(data) // 2
        return data[:at] + _of(opening) + data[at:]

    return make


def digits(reader: Reader, data: bytes) -> bytes:
    """Numbers of a million digits."""
    count = 0

    def longer(match: re.Match[bytes]) -> bytes:
        nonlocal count
        count += 1
        return b"9" * (SIZE // 4) if count in (1, 3, 7, 20) else match[0]

    return _NUMBER.sub(longer, data)


def repeated(reader: Reader, data: bytes) -> bytes:
    """The last lines or bytes, many times."""
    tail = data[len(data) * 2 // 3 :]
    return data + _of(tail) if tail else data


def lines(reader: Reader, data: bytes) -> bytes:
    """The file's last line but one, many times: more entries than any scene has."""
    rows = data.split(b"\n")
    row = rows[-2] if len(rows) > 2 else rows[-1]
    return b"\n".join([*rows[:-1], *[row] * (SIZE // (len(row) + 1)), rows[-1]])


def zeros(reader: Reader, data: bytes) -> bytes:
    """Zeros behind the unpacked content: compressed ones take a thousandth."""
    return reader.pack(reader.unpack(data) + bytes(16 * SIZE))


def counts(value: bytes, at: int) -> Bomb:
    """An integer in the header, where counts and sizes are."""

    def make(reader: Reader, data: bytes) -> bytes:
        return data[:at] + value + data[at + len(value) :]

    return make


def packed_counts(value: bytes, at: int) -> Bomb:
    """An integer in the unpacked content, where counts and sizes are."""

    def make(reader: Reader, data: bytes) -> bytes:
        return reader.pack(counts(value, at)(reader, reader.unpack(data)))

    return make


BOMBS: dict[str, Bomb] = {
    **{f"nested {opening!r}": nested(opening) for opening in (b"[", b'{"a":', b"<a>", b"(", b"- ")},
    "wide": nested(b"{},"),
    "digits": digits,
    "repeated": repeated,
    "lines": lines,
    "zeros": zeros,
    **{
        f"{make.__name__} {value.hex()} at {at}": make(value, at)
        for make in (counts, packed_counts)
        for value in (b"\xff\xff\xff\x7f", b"\x00\x00\x00\x40\x00\x00")
        for at in (8, 12, 16, 20)
    },
}
ENDLESS = ("pipe", "device", "sparse")


def write_endless(path: Path, kind: str) -> None:
    """A file that has no end, or claims to have 4 TiB."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.touch()
        os.truncate(path, 1 << 42)
