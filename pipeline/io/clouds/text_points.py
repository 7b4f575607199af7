"""Points of text files: XYZ, CSV and PTS.

One point a line, separated by spaces, tabs, commas or semicolons: ``x y z``, then red, green, blue
and intensity; in PTS files (Leica) intensity comes before the colour. A first line with names says
which column is which. Lines that begin with ``#`` or ``//`` are comments.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.io.bounded import opened_regular
from pipeline.io.clouds.values import Chunk, Chunks, damaged, stacked
from pipeline.runtime.errors import UserError

# The number of bytes that are read at a time, and those of the longest line.
_BLOCK, MAX_LINE = 1 << 22, 1 << 16
_COMMENTS = (b"#", b"//")
_SEPARATORS = (b";", b",")
_NAMES = (
    ("x", "easting", "east", "e"),
    ("y", "northing", "north", "n"),
    ("z", "height", "elevation", "altitude", "up"),
    ("r", "red"),
    ("g", "green"),
    ("b", "blue"),
)
# Characters of an unreadable line that a message quotes.
_QUOTED = 60


@dataclass(frozen=True)
class _Columns:
    """Indices of the columns of positions and colours, and the separator (None: white space)."""

    xyz: tuple[int, ...]
    rgb: tuple[int, ...]
    separator: str | None


def read_text(path: Path) -> Chunks:
    """The points of a text file.

    Raises:
        UserError: a line that is too long, is not numbers, or has another number of columns.
    """
    pts = path.suffix.lower() == ".pts"
    columns: _Columns | None = None
    named: list[str] = []
    with opened_regular(path) as file:
        for block in text_blocks(file, path):
            lines = []
            for line in block:
                line = line.strip()
                if not line or (pts and line.isdigit()):  # PTS: the number of points.
                    continue
                if columns is None and (found := _names(line)):
                    named = found
                elif not line.startswith(_COMMENTS):
                    columns = columns or _columns(line, named, pts, path)
                    lines.append(line)
            if columns is None or not lines:
                continue
            values = parsed(lines, columns.separator, path)
            if values.shape[1] <= max((*columns.xyz, *columns.rgb)):
                raise _no_position(path, lines[0])
            xyz = stacked([values[:, i] for i in columns.xyz], np.float64)
            if not columns.rgb:
                yield Chunk(xyz)
            else:
                with np.errstate(over="ignore"):
                    yield Chunk(xyz, stacked([values[:, i] for i in columns.rgb], np.float32))


def text_blocks(file: BinaryIO, path: Path) -> Iterator[list[bytes]]:
    """Lists of lines without their ends, a few megabytes each.

    Raises:
        UserError: a line is longer than ``MAX_LINE``.
    """
    rest = b""
    while data := file.read(_BLOCK):
        lines = (rest + data).split(b"\n")
        rest = lines.pop()
        if len(rest) > MAX_LINE or max(map(len, lines), default=0) > MAX_LINE:
            raise damaged(path, f"expected lines of numbers, found one of over {MAX_LINE} bytes")
        yield lines
    if rest:
        yield [rest]


def parsed(lines: list[bytes], separator: str | None, path: Path) -> NDArray[np.float64]:
    """(N, columns) numbers; numbers beyond float64 are infinite.

    Raises:
        UserError: Values are not numbers, or lines differ in length.
    """
    text = [line.decode("latin-1") for line in lines]
    if not text:
        return np.zeros((0, 0))
    try:
        return np.loadtxt(text, np.float64, comments=None, delimiter=separator, ndmin=2)
    except ValueError as error:
        reason = str(error)[: 2 * _QUOTED]
        raise damaged(path, f"expected the same number of numbers in each line: {reason}") from None


def _columns(line: bytes, named: list[str], pts: bool, path: Path) -> _Columns:
    separator = _separator(line)
    count = len(line.split(separator))
    if count < 3:
        raise _no_position(path, line)
    text = separator.decode() if separator else None
    if named:
        found = [next((named.index(n) for n in names if n in named), -1) for names in _NAMES]
        return _Columns(tuple(found[:3]), tuple(found[3:]) if min(found[3:]) >= 0 else (), text)
    first = 4 if pts and count >= 7 else 3
    return _Columns((0, 1, 2), tuple(range(first, first + 3)) if count >= 6 else (), text)


def _no_position(path: Path, line: bytes) -> UserError:
    return damaged(path, f"expected x, y and z in each line, found {line[:_QUOTED]!r}")


def _separator(line: bytes) -> bytes | None:
    return next((mark for mark in _SEPARATORS if mark in line), None)


def _names(line: bytes) -> list[str]:
    """The columns' names in a first line, lower case; empty if they are not there."""
    plain = line.removeprefix(b"\xef\xbb\xbf").lstrip(b"#/ ")
    words = plain.decode("latin-1").split((_separator(plain) or b"").decode() or None)
    names = [word.strip(" \"'").casefold() for word in words]
    return names if all(any(n in names for n in axis) for axis in _NAMES[:3]) else []
