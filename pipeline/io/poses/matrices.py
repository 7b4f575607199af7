"""Pose matrices of other programs' files, checked for the ways in which people write them wrongly.

A pose is a 4x4 matrix in rows, whose last column is the translation and whose last row is
0 0 0 1, or its first three rows. Values may be nested lists or one list in the order of rows.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.io.poses.files import FIX, malformed
from pipeline.runtime.text import shown

Array = NDArray[np.float64]

LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])
# Accepted error of the last row: printing with few digits causes less, and no row of a rotation
# together with a translation is as near to it by chance.
_TOLERANCE = 1e-3
_LARGEST = 1e15
_SHAPES = {(4, 4): (4, 4), (3, 4): (3, 4), (16,): (4, 4), (12,): (3, 4)}
_FIX_TRANSPOSED = (
    "transpose the matrices, so that the translation is the last column and 0 0 0 1 the last row, "
    "or set poses: ignore"
)


def pose_matrix(file: Path, where: str, value: Any) -> Array:
    """``value`` as a finite (4, 4) matrix; three rows get the last row of the identity.

    Raises:
        UserError: Other shapes, values that are no moderate numbers, a translation in the last
            row, or another last row than 0 0 0 1.
    """
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape not in _SHAPES:
        raise malformed(file, f"{where}: expected 4x4 numbers, found {shown(value)}")
    matrix = matrix.reshape(_SHAPES[matrix.shape])
    if not (np.abs(matrix) < _LARGEST).all():
        largest = shown(np.abs(matrix).max())
        raise malformed(file, f"{where}: expected values below {_LARGEST:g}, found {largest}")
    full = np.eye(4)
    full[: len(matrix)] = matrix
    _check_last_row(file, where, full)
    full[3] = LAST_ROW
    return full


def _check_last_row(file: Path, where: str, matrix: Array) -> None:
    if np.abs(matrix[3] - LAST_ROW).max() < _TOLERANCE:
        return
    row = " ".join(f"{value:.4g}" for value in matrix[3])
    if np.abs(matrix[:, 3] - LAST_ROW).max() < _TOLERANCE:
        raise malformed(
            file,
            f"{where}: the matrix is transposed: its translation is in the last row ({row}), "
            "expected in the last column",
            fix=_FIX_TRANSPOSED,
        )
    raise malformed(file, f"{where}: expected the last row 0 0 0 1, found {row}")


def rotation_fault(matrix: Array) -> tuple[str, str]:
    """What a (3, 3) matrix that is not a rotation is, and what to do."""
    if not np.isfinite(matrix).all():
        return "the matrix is not a rotation: it has values that are not finite", FIX
    lengths = np.linalg.norm(matrix, axis=0)
    unit = matrix / np.maximum(lengths, 1e-300)
    if np.abs(unit.T @ unit - np.eye(3)).max() > 0.03:
        return "the matrix is not a rotation: its axes are not perpendicular", FIX
    if np.linalg.det(unit) < 0:
        return (
            "the matrix is not a rotation but mirrored (its determinant is negative): one axis of "
            "the camera or of the world is left-handed",
            "negate or exchange the axis that was mirrored (COLMAP's cameras: x right, y down, z "
            "forward; OpenGL's: x right, y up, z backward), or set poses: ignore",
        )
    found = ", ".join(f"{length:.4g}" for length in lengths)
    return (
        f"the matrix is not a rotation: its axes have the lengths {found}, expected 1",
        "divide the rotation by its scale, or set poses: ignore",
    )
