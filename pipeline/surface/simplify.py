"""Fewer triangles by quadric error metrics (Garland and Heckbert 1997)."""

from __future__ import annotations

import fast_simplification
import numpy as np
from numpy.typing import NDArray

#: The triangles that are kept, as a share of those of marching cubes, unless a number is given.
#: Marching cubes cut flat and curved surfaces alike into triangles of a voxel's size.
SHARE = 0.125


def simplify(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], count: int | None, voxel: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Collapse edges until ``count`` triangles are left, those first that move the surface least.
    Edges between the boundary and the inside are kept, so that holes do not grow.

    Args:
        vertices: (V, 3). faces: (F, 3).
        count: The number of triangles; None: ``SHARE`` of them. More than ``faces`` changes
            nothing.
        voxel: The unit of length of the error thresholds.

    Returns:
        (W, 3) vertices and (G, 3) faces, about ``count``; all vertices are used.
    """
    wanted = int(np.ceil(SHARE * len(faces))) if count is None else count
    if wanted >= len(faces):
        return vertices, faces
    # The thresholds of the library are absolute.
    origin = vertices.mean(axis=0)
    found, triangles = fast_simplification.simplify(
        (vertices - origin) / voxel, faces.astype(np.int32), target_count=wanted
    )
    triangles = triangles.astype(np.int64)
    a, b, c = (found[triangles[:, i]] for i in range(3))
    triangles = triangles[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0]
    triangles = _without_pairs(triangles)
    used = np.zeros(len(found), bool)
    used[triangles] = True
    return found[used] * voxel + origin, (np.cumsum(used) - 1)[triangles]


def _without_pairs(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """The faces without pairs that have the same corners: folds, which bound no volume."""
    _, same, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return np.asarray(faces[count[same.ravel()] == 1])
