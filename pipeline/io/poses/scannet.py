"""Folders of ScanNet and of ARKit scans in its form: ``pose/``, ``color/`` and ``intrinsic/``.

``pose/N.txt`` is camera to world with COLMAP's axes, 4x4; a frame whose tracking was lost has
values that are not finite. ``intrinsic/intrinsic_color.txt`` is the camera matrix for the images
in ``color/``. Source: ScanNet's ``SensReader``.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.io.poses.files import first_file, malformed, numbers, read_text
from pipeline.io.poses.frames import Lens, PosedFrame, checked_camera, make_frame
from pipeline.io.poses.matrices import pose_matrix

_INTRINSICS = ("intrinsic/intrinsic_color.txt", "intrinsic_color.txt", "intrinsic/intrinsic.txt")


def find(folder: Path) -> str | None:
    if not (folder / "color").is_dir() or not (folder / "pose").is_dir():
        return None
    has_all = _intrinsics(folder) is not None and len(files(folder)) > 1
    return "." if has_all else None


def files(path: Path) -> list[Path]:
    """The files of a scene folder."""
    intrinsics = _intrinsics(path)
    poses = sorted(file for file in (path / "pose").glob("*.txt") if file.is_file())
    return [*poses, *([intrinsics] if intrinsics is not None else [])]


def frames(path: Path) -> list[PosedFrame]:
    """The tracked frames of a scene folder.

    Raises:
        UserError: a malformed file, or no tracked frame.
    """
    *poses, intrinsics = files(path)
    matrix = _matrix(intrinsics, (3, 4))
    lens = Lens("PINHOLE", partial(_camera, intrinsics, matrix))
    found = []
    for file in poses:
        if _is_lost(file):
            continue
        pose = pose_matrix(file, file.name, _matrix(file, (4,)))
        name = f"color/{file.stem}"
        found.append(make_frame(file, name, lens, pose[:3, :3].T, pose[:3, 3], file.name))
    if not found:
        raise malformed(poses[0], "expected a finite pose in one of the files, found none")
    return found


def lost(path: Path) -> list[str]:
    """The photographs whose tracking was lost."""
    return [f"color/{file.stem}" for file in files(path)[:-1] if _is_lost(file)]


def _is_lost(file: Path) -> bool:
    try:
        values = np.array([float(word) for word in read_text(file).split()])
    except ValueError:
        return False
    return values.size == 16 and not np.isfinite(values).all()


def _matrix(file: Path, rows: tuple[int, ...]) -> NDArray[np.float64]:
    """The (4, 4) matrix in a text file, or a (3, 3) one if ``rows`` allows it."""
    words = read_text(file).split()
    side = 3 if len(words) == 9 and 3 in rows else 4
    return numbers(file, file.name, words, side * side).reshape(side, side)


def _camera(file: Path, matrix: NDArray[np.float64], width: int, height: int) -> Camera:
    params = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    return checked_camera(file, file.name, "PINHOLE", width, height, params)


def _intrinsics(folder: Path) -> Path | None:
    name = first_file(folder, _INTRINSICS)
    return None if name is None else folder / name
