"""Point clouds in every format, by the formats' own writers where there are some."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

XYZ, RGB = NDArray[np.float64], NDArray[np.uint8]


def write_ply(
    path: Path, xyz: XYZ, rgb: RGB | None, form: str = "binary_little_endian", kind: str = "double"
) -> None:
    order = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}[form]
    code = {"double": "f8", "float": "f4"}[kind]
    names = [f"property {kind} {axis}" for axis in "xyz"]
    fields = [(axis, order + code) for axis in "xyz"]
    if rgb is not None:
        names += [f"property uchar {c}" for c in ("red", "green", "blue")]
        fields += [(c, "u1") for c in ("red", "green", "blue")]
    table = np.zeros(len(xyz), np.dtype(fields))
    for i, axis in enumerate("xyz"):
        table[axis] = xyz[:, i]
    for i, c in enumerate(("red", "green", "blue") if rgb is not None else ()):
        table[c] = rgb[:, i]
    header = ["ply", f"format {form} 1.0", "comment made", f"element vertex {len(xyz)}", *names]
    body = table.tobytes()
    if form == "ascii":
        body = "".join(" ".join(repr(v) for v in row.tolist()) + "\n" for row in table).encode()
        body = body.replace(b"(", b"").replace(b")", b"").replace(b",", b"")
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + body)


def write_las(path: Path, xyz: XYZ, rgb: RGB | None, bits: int = 16, version: str = "1.2") -> None:
    import laspy

    header = laspy.LasHeader(point_format=0 if rgb is None else 2, version=version)
    header.scales, header.offsets = np.full(3, 1e-4), np.floor(xyz.min(0))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    if rgb is not None:
        factor = 257 if bits == 16 else 1
        las.red, las.green, las.blue = rgb.T.astype(np.uint16) * factor
    las.write(path)


def write_e57(path: Path, xyz: XYZ, rgb: RGB | None, shift: XYZ) -> None:
    """``shift``: of the scan's pose along each axis. The writer stores float32."""
    import pye57

    data = {f"cartesian{axis}": xyz[:, i] - shift[i] for i, axis in enumerate("XYZ")}
    if rgb is not None:
        data |= {f"color{c}": rgb[:, i].copy() for i, c in enumerate(("Red", "Green", "Blue"))}
    file = pye57.E57(str(path), mode="w")
    pose = {"rotation": np.array([1.0, 0, 0, 0]), "translation": shift}
    file.write_scan_raw(data, **pose)
    file.close()


def write_text(path: Path, xyz: XYZ, rgb: RGB | None, separator: str = " ") -> None:
    rows = [[repr(v) for v in row] for row in xyz.tolist()]
    if path.suffix == ".pts":
        lines = [str(len(rows))]
        rows = [[*row, "-1200"] for row in rows]
    else:
        lines = []
    if rgb is not None:
        rows = [[*row, *map(str, c)] for row, c in zip(rows, rgb.tolist(), strict=True)]
    path.write_text("\n".join([*lines, *(separator.join(row) for row in rows), ""]))
