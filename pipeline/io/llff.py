"""``poses_bounds.npy`` of LLFF: one row of 17 numbers per photograph, sorted by name.

A row is a 3x5 matrix (camera to world; the last column is height, width and focal length in
pixels) followed by the nearest and farthest depth. The camera axes are down, right, backward.
Source: the LLFF repository's README, "Using your own poses without running COLMAP".
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.io.arrays import read_array
from pipeline.io.bounded import MIB, read_bounded
from pipeline.io.poses.files import malformed
from pipeline.io.poses.matrices import rotation_fault
from pipeline.scene.reconstruction import PosedImage, Reconstruction

_MAX_BYTES = 64 * MIB
_FIX = "export the poses again with as many rows as photographs, or set poses: ignore"


def read_poses_bounds(path: Path, names: Sequence[str]) -> Reconstruction:
    """Read LLFF poses.

    Args:
        path: The ``.npy`` file.
        names: The photographs, sorted by name: row i belongs to photograph i.

    Returns:
        SIMPLE_PINHOLE cameras of the file's size, no points.

    Raises:
        UserError: The file is not a ``poses_bounds.npy``, another number of rows than photographs,
            values that are not finite, a matrix that is not a rotation.
    """
    rows = read_rows(path)
    if len(rows) != len(names):
        raise malformed(
            path, f"holds {len(rows)} poses, but there are {len(names)} photographs", _FIX
        )
    cameras: dict[int, Camera] = {}
    numbers: dict[tuple, int] = {}
    images: dict[int, PosedImage] = {}
    for i, name in enumerate(names):
        matrix = rows[i, :15].reshape(3, 5)
        down, right, backward, centre, (height, width, focal) = matrix.T
        rotation = np.stack([right, down, -backward])
        with np.errstate(over="ignore", invalid="ignore"):
            error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not error <= 1e-2 or np.linalg.det(rotation) < 0:
            fault, fix = rotation_fault(rotation)
            raise malformed(path, f"row {i} ({name}): {fault}", fix)
        if min(height, width) < 1 or focal <= 0:
            raise malformed(
                path,
                f"row {i} ({name}): expected positive height, width and focal length, found "
                f"{height:g}, {width:g}, {focal:g}",
                _FIX,
            )
        camera_id = numbers.setdefault((width, height, focal), len(numbers) + 1)
        params = np.array([focal, width / 2, height / 2])
        cameras[camera_id] = Camera("SIMPLE_PINHOLE", round(width), round(height), params)
        images[i + 1] = PosedImage(name, camera_id, rotation, -rotation @ centre)
    return Reconstruction(cameras, images)


def read_rows(path: Path) -> NDArray[np.float64]:
    """The file's (N, 17) finite numbers.

    Raises:
        UserError: The file is not a ``poses_bounds.npy``, or values that are not finite.
    """
    try:
        rows = np.asarray(read_array(read_bounded(path, _MAX_BYTES, fix=_FIX)), np.float64)
    except ValueError as error:
        raise malformed(path, f"not a NumPy array of numbers ({error})", _FIX) from None
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise malformed(path, f"expected N x 17 numbers, found shape {rows.shape}", _FIX)
    bad = np.flatnonzero(~np.isfinite(rows).all(1))
    if len(bad):
        raise malformed(path, f"row {bad[0]}: holds values that are not finite", _FIX)
    return rows
