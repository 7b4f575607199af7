"""Pix4D: ``PROJECT_calibrated_camera_parameters.txt``, with ``PROJECT_offset.xyz``.

For each image ten lines: name, width and height; K; radial distortion; tangential distortion
(OpenCV's order); the centre t; the rotation R, world to camera with COLMAP's axes (x = K [R | -R t]
X). The offset, if the file is there, was subtracted from the coordinates. Source: Pix4D's
documentation, "What does the Output Params folder contain".
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.io.poses.files import find_by_head, malformed, number, numbers, read_text
from pipeline.io.poses.frames import Lens, PosedFrame, make_frame
from pipeline.io.poses.lenses import Brown, brown_camera
from pipeline.runtime.text import shown

_SUFFIX = "calibrated_camera_parameters.txt"
_LINES = 10


def find(folder: Path) -> str | None:
    name = find_by_head(folder, ".txt", lambda head: b"camera rotation R [3x3]" in head)
    return name if name is not None and name.endswith(_SUFFIX) else None


def files(path: Path) -> list[Path]:
    offset = path.with_name(path.name.removesuffix(_SUFFIX) + "offset.xyz")
    return [path, offset] if offset.is_file() else [path]


def frames(path: Path) -> list[PosedFrame]:
    """The images of the file.

    Raises:
        UserError: The files are malformed.
    """
    offset = _offset(path)
    lines = [line.strip() for line in read_text(path).splitlines()]
    heads = [i for i, line in enumerate(lines) if line.startswith("camera model")]
    rows = [line for line in lines[heads[0] + 1 if heads else 0 :] if line]
    if not heads or not rows or len(rows) % _LINES:
        raise malformed(path, f"expected {_LINES} lines for each image after 'camera model ...'")
    found = []
    for start in range(0, len(rows), _LINES):
        head, *block = rows[start : start + _LINES]
        *words, width, height = ("", "", *head.split())
        name = " ".join(words).strip()
        where = f"image {shown(name)}"
        lens = _lens(path, where, width, height, block)
        rotation = np.stack([numbers(path, f"{where}: R", row, 3) for row in block[6:9]])
        centre = numbers(path, f"{where}: t", block[5], 3) + offset
        found.append(make_frame(path, name, lens, rotation, centre, where))
    return found


def _lens(file: Path, where: str, width: str, height: str, block: list[str]) -> Lens:
    k = np.stack([numbers(file, f"{where}: K", row, 3) for row in block[:3]])
    radial = numbers(file, f"{where}: radial distortion", block[3], 3).tolist()
    p1, p2 = numbers(file, f"{where}: tangential distortion", block[4], 2).tolist()
    w, h = (number(file, f"{where}: size", value) for value in (width, height))
    lens = Brown(k[0, 0], k[1, 1], k[0, 2], k[1, 2], k=tuple(radial), p=(p1, p2), skew=k[0, 1])
    return Lens.fixed(brown_camera(file, where, w, h, lens))


def _offset(path: Path) -> NDArray[np.float64]:
    _, *offset = files(path)
    if not offset:
        return np.zeros(3)
    return numbers(offset[0], "the offset", read_text(offset[0]).replace(",", " "), 3)
