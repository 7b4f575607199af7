"""Points of PLY files: ASCII or binary with either byte order, float or double."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.io.bounded import opened_regular
from pipeline.io.clouds.text_points import parsed, text_blocks
from pipeline.io.clouds.values import CHUNK_POINTS, Chunk, Chunks, damaged, stacked
from pipeline.io.ply_header import PlyHeader, read_header

_POSITION = ("x", "y", "z")
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
# Full intensity of integer types.
_FULL = {"u1": 255.0, "u2": 65535.0}
# Bytes that are in memory at a time: rows may have thousands of properties.
_CHUNK_BYTES = 1 << 26


def count_ply(path: Path) -> int:
    """Number of points according to the header."""
    with opened_regular(path) as file:
        return read_header(file, path).count


def read_ply(path: Path) -> Chunks:
    """The points of a PLY file.

    Raises:
        UserError: the header has no x, y and z, or the file is shorter than it says.
    """
    with opened_regular(path) as file:
        header = read_header(file, path)
        if missing := [name for name in _POSITION if name not in header.fields]:
            raise damaged(path, f"expected points with x, y and z, found no {missing[0]}")
        names = next((c for c in _COLOURS if all(n in header.fields for n in c)), None)
        tables = _binary(file, header, path) if header.byte_order else _ascii(file, header, path)
        for table in tables:
            xyz = stacked([table[name] for name in _POSITION], np.float64)
            if names is None:
                yield Chunk(xyz)
            else:
                colour = stacked([table[name] for name in names], np.float32)
                yield Chunk(xyz, colour, _FULL.get(header.fields[names[0]]))


def _binary(file: BinaryIO, header: PlyHeader, path: Path):  # type: ignore[no-untyped-def]
    dtype = np.dtype([(name, header.byte_order + code) for name, code in header.fields.items()])
    start = file.tell()
    found, expected = file.seek(0, 2) - start, header.count * dtype.itemsize
    if found < expected:
        raise damaged(
            path, f"expected {expected} bytes of {header.count} points, found {max(found, 0)}"
        )
    file.seek(start)
    rows = max(1, min(CHUNK_POINTS, _CHUNK_BYTES // dtype.itemsize))
    for first in range(0, header.count, rows):
        size = min(rows, header.count - first) * dtype.itemsize
        data = file.read(size)
        if len(data) < size:
            raise damaged(path, "expected no change while the file is read, found a shorter file")
        yield np.frombuffer(data, dtype)


def _ascii(file: BinaryIO, header: PlyHeader, path: Path):  # type: ignore[no-untyped-def]
    missing = header.count
    for block in text_blocks(file, path):
        if not missing:
            return
        lines = list(islice((line for line in block if line.strip()), missing))
        if not lines:
            continue
        missing -= len(lines)
        values: NDArray[np.float64] = parsed(lines, None, path)
        if values.shape[1] != len(header.fields):
            raise damaged(
                path, f"expected {len(header.fields)} numbers a line, found {values.shape[1]}"
            )
        yield dict(zip(header.fields, values.T, strict=True))
    if missing:
        raise damaged(
            path, f"expected {header.count} lines of points, found {header.count - missing}"
        )
