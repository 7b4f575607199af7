"""Quaternions (wxyz, COLMAP's order) and rotation matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def quat_to_rotation(quat: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 4) quaternions wxyz, any positive norm, to (..., 3, 3) rotations."""
    q = np.asarray(quat, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def rotation_to_quat(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3, 3) rotations to (..., 4) unit quaternions wxyz with w >= 0.

    Shepperd's method (1978): normalise the row of q q^T (linear in R) that has the largest
    diagonal element, so that the divisor is never small.
    """
    r = np.asarray(rotation, np.float64)
    m00, m01, m02 = r[..., 0, 0], r[..., 0, 1], r[..., 0, 2]
    m10, m11, m12 = r[..., 1, 0], r[..., 1, 1], r[..., 1, 2]
    m20, m21, m22 = r[..., 2, 0], r[..., 2, 1], r[..., 2, 2]
    rows = [
        [1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01],
        [m21 - m12, 1 + m00 - m11 - m22, m01 + m10, m02 + m20],
        [m02 - m20, m01 + m10, 1 - m00 + m11 - m22, m12 + m21],
        [m10 - m01, m02 + m20, m12 + m21, 1 - m00 - m11 + m22],
    ]
    outer = np.stack([np.stack(row, -1) for row in rows], -2)
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), -1)
    q = np.take_along_axis(outer, best[..., None, None], -2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    result: NDArray[np.float64] = np.where(q[..., :1] < 0, -q, q)
    return result


def rotation_from_vector(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) rotation vector, the axis times the angle in radians, to a (3, 3) rotation."""
    half = 0.5 * float(np.linalg.norm(vector))
    # np.sinc(x) is sin(pi x) / (pi x).
    return quat_to_rotation(np.array([np.cos(half), *(0.5 * np.sinc(half / np.pi) * vector)]))
