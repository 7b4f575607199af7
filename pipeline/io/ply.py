"""PLY files: Gaussians in 3DGS's layout, and coloured point clouds for mesh programs.

3DGS's layout (Kerbl et al. 2023, reference code) is one ``vertex`` element of little-endian float32
properties: ``x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3``. Scales are natural
logarithms, opacity is a logit, rotation is wxyz; ``f_rest`` is ordered by channel (all red
coefficients of the higher bands, then green, then blue). Normals are zero. Other programs omit or
reorder properties, so they are read by name.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.io.bounded import opened_bounded
from pipeline.io.ply_header import ANTIALIASED, PlyHeader, read_header, wrong
from pipeline.io.splat_codec import FIX
from pipeline.runtime.atomic import write_pieces
from pipeline.runtime.errors import UserError
from pipeline.splats.arrays import NAMES, GaussianSource
from pipeline.splats.gaussians import Gaussians

# Lines of text that are parsed at a time.
_ROWS = 10_000
_POSITION = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_SCALE = tuple(f"scale_{i}" for i in range(3))
_ROTATION = tuple(f"rot_{i}" for i in range(4))
_DC = tuple(f"f_dc_{i}" for i in range(3))
_REQUIRED = (*_POSITION, *_DC, "opacity", *_SCALE, *_ROTATION)


def write_splat_ply(path: Path, gaussians: GaussianSource, *, antialias: bool = False) -> None:
    """Write Gaussians in 3DGS's layout atomically: 62 floats each at SH degree 3, fewer at lower
    degrees.

    Args:
        antialias: Whether the Gaussians were trained with Mip-Splatting's opacity compensation,
            which a comment of the header records.
    """
    rest = [f"f_rest_{i}" for i in range(3 * ((gaussians.sh_degree + 1) ** 2 - 1))]
    names = [*_POSITION, *_NORMAL, *_DC, *rest, "opacity", *_SCALE, *_ROTATION]

    def rows() -> Iterator[bytes]:
        for means, log_scales, quats, logits, sh in gaussians.chunks(*NAMES):
            count = len(means)
            columns = (
                means,
                np.zeros((count, 3)),
                sh[:, 0],
                sh[:, 1:].transpose(0, 2, 1).reshape(count, len(rest)),
                logits[:, None],
                log_scales,
                quats,
            )
            yield np.concatenate(columns, axis=1, dtype="<f4").tobytes()

    properties = [("float", name) for name in names]
    _write(path, len(gaussians), properties, rows(), [ANTIALIASED] if antialias else [])


def write_points_ply(
    path: Path,
    xyz: NDArray[Any],
    rgb: NDArray[np.uint8],
    normals: NDArray[Any] | None = None,
    *,
    double: bool = False,
) -> None:
    """Write a coloured point cloud for mesh programs atomically: float32 positions (and normals),
    uchar red, green, blue.

    Args:
        xyz, rgb: The positions and the colours, (P, 3).
        normals: The normals, (P, 3), or None.
        double: Whether positions are float64, for coordinates that do not fit into float32.
    """
    columns = [("double", "f8", _POSITION, xyz) if double else ("float", "f4", _POSITION, xyz)]
    if normals is not None:
        columns.append(("float", "f4", _NORMAL, normals))
    columns.append(("uchar", "u1", ("red", "green", "blue"), rgb))
    if any(np.shape(values) != (len(xyz), 3) for *_, values in columns):
        raise ValueError(f"expected arrays of equal shape, got {[np.shape(c[3]) for c in columns]}")
    fields = [(n, f"<{code}") for _, code, names, _ in columns for n in names]
    table = np.zeros(len(xyz), np.dtype(fields))
    for _, _, names, values in columns:
        for i, name in enumerate(names):
            table[name] = values[:, i]
    properties = [(kind, name) for kind, _, names, _ in columns for name in names]
    _write(path, len(xyz), properties, [table.tobytes()])


def _write(
    path: Path,
    count: int,
    properties: list[tuple[str, str]],
    body: Iterable[bytes],
    comments: Sequence[str] = (),
) -> None:
    lines = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {count}"]
    lines += [f"property {kind} {name}" for kind, name in properties]
    write_pieces(path, chain(["\n".join([*lines, "end_header", ""]).encode()], body))


def is_antialiased_ply(path: Path) -> bool:
    """Whether a PLY file records that the Gaussians were trained with opacity compensation; False
    for a file that cannot be read."""
    with contextlib.suppress(UserError), opened_bounded(path, fix=FIX) as file:
        return read_header(file, path).antialiased
    return False


def read_splat_ply(path: Path) -> Gaussians:
    """Read Gaussians of SH degree 0 to 3 by property name.

    Properties may be in any order and of any number type, normals are optional; the file may be
    ASCII or binary with either byte order.

    Raises:
        UserError: the file is missing, has no Gaussians, or is shorter or longer than its header
            implies.
    """
    with opened_bounded(path, fix=FIX) as file:
        header = read_header(file, path)
        rest = [name for name in header.fields if name.startswith("f_rest_")]
        names = [*_REQUIRED, *(f"f_rest_{i}" for i in range(len(rest)))]
        missing = next((name for name in names if name not in header.fields), None)
        if missing:
            raise wrong(path, f"expected the properties of Gaussians, found no {missing}")
        if len(rest) not in (0, 9, 24, 45):
            raise wrong(path, f"expected 0, 9, 24 or 45 f_rest properties, found {len(rest)}")
        table = _read_body(file, header, path)
    bands = len(rest) // 3 + 1

    def columns(names: tuple[str, ...]) -> NDArray[np.float32]:
        return np.stack([table[name].astype(np.float32) for name in names], axis=1)

    sh = np.empty((header.count, bands, 3), np.float32)
    sh[:, 0] = columns(_DC)
    for channel in range(3):
        for band in range(bands - 1):
            sh[:, band + 1, channel] = table[f"f_rest_{channel * (bands - 1) + band}"]
    return Gaussians.from_arrays(
        {
            "means": columns(_POSITION),
            "log_scales": columns(_SCALE),
            "quats": columns(_ROTATION),
            "opacity_logits": table["opacity"],
            "sh": sh,
        }
    )


def _read_body(file: BinaryIO, header: PlyHeader, path: Path) -> dict[str, NDArray[Any]]:
    """(count,) values of each property."""
    if not header.byte_order:
        return _read_ascii(file, header, path)
    dtype = np.dtype([(name, header.byte_order + code) for name, code in header.fields.items()])
    start = file.tell()
    found, expected = file.seek(0, 2) - start, header.count * dtype.itemsize
    if found < expected or (found > expected and not header.more):
        raise wrong(
            path,
            f"expected {expected} bytes of {header.count} Gaussians after the header, "
            f"found {found}",
        )
    file.seek(start)
    table = np.frombuffer(file.read(expected), dtype)
    return {name: table[name] for name in header.fields}


def _read_ascii(file: BinaryIO, header: PlyHeader, path: Path) -> dict[str, NDArray[Any]]:
    body = file.read()
    rows = body.splitlines()
    if len(rows) < header.count or (len(rows) > header.count and not header.more):
        raise wrong(path, f"expected {header.count} lines of Gaussians, found {len(rows)}")
    try:
        if 2 * header.count * len(header.fields) > len(body) + 1:  # A digit and a separator each.
            raise ValueError
        values = np.empty((header.count, len(header.fields)))
        # Write in pieces: a number takes ten times as much memory as an object.
        for start in range(0, header.count, _ROWS):
            piece = [row.split() for row in rows[start : min(start + _ROWS, header.count)]]
            values[start : start + _ROWS] = np.array(piece, np.float64)
    except ValueError:
        raise wrong(path, f"expected {len(header.fields)} numbers in each line") from None
    return dict(zip(header.fields, values.T, strict=True))
