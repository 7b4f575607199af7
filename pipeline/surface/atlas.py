"""Texture coordinates: the mesh cut into charts, packed into one square (xatlas)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xatlas
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Texels between charts.
PADDING = 2
#: Triangles that are cut into charts at a time, one part in a thread.
PART = 1024


@dataclass(frozen=True)
class Atlas:
    """A mesh whose vertices are doubled where charts end.

    Attributes:
        source: (W,) int64 the vertex of the mesh that each vertex is.
        faces: (F, 3) int64, in the order of ``origin``.
        origin: (F,) int64 the triangle of the mesh that each triangle is.
        uv: (W, 2) float64 texture coordinates in pixels of a texture of ``size``.
        size: The width and height of the texture.
    """

    source: NDArray[np.int64]
    faces: NDArray[np.int64]
    origin: NDArray[np.int64]
    uv: Array
    size: tuple[int, int]


def cut_and_pack(vertices: Array, faces: NDArray[np.int64], density: Array, most: int) -> Atlas:
    """Cut a mesh into charts of little distortion and pack them.

    Args:
        vertices: (V, 3). faces: (F, 3).
        density: (F,) wanted texels per unit of length on each triangle.
        most: The largest width and height of the texture.
    """
    area = _areas(vertices, faces)
    wanted = float((area * density**2).sum())
    # More texels than the texture has are not needed, and float32 has a largest number.
    density = density * min(1.0, most / np.sqrt(max(wanted, 1e-300)))
    atlas = xatlas.Atlas()
    parts = split(vertices[faces].mean(axis=1), PART)
    locals_ = []
    for part in parts:
        used, local = np.unique(faces[part], return_inverse=True)
        texels = float((area[part] * density[part] ** 2).sum())
        scale = np.sqrt(texels / max(float(area[part].sum()), 1e-300))
        # Around an origin of its own, to keep float32's precision.
        points = (vertices[used] - vertices[used].mean(axis=0)) * scale
        atlas.add_mesh(points.astype(np.float32), local.reshape(-1, 3).astype(np.uint32))
        locals_.append(used)
    options = xatlas.PackOptions()
    options.padding = PADDING
    options.resolution = int(np.clip(np.sqrt(wanted / 0.7), 32, most))
    # Packing a chart much larger than the texture takes memory without end.
    options.max_chart_size = options.resolution
    atlas.generate(xatlas.ChartOptions(), options)
    source, triangles, coordinates, count = [], [], [], 0
    for number, used in enumerate(locals_):
        vertex, index, uv = atlas[number]
        source.append(used[vertex])
        triangles.append(index.astype(np.int64) + count)
        coordinates.append(uv.astype(np.float64))
        count += len(vertex)
    shrink = min(1.0, most / max(atlas.width, atlas.height))
    width, height = (max(1, int(np.ceil(n * shrink))) for n in (atlas.width, atlas.height))
    uv = np.concatenate(coordinates) * (atlas.width * shrink, atlas.height * shrink)
    return Atlas(
        np.concatenate(source),
        np.concatenate(triangles),
        np.concatenate(parts),
        uv,
        (min(width, most), min(height, most)),
    )


def split(points: Array, limit: int) -> list[NDArray[np.intp]]:
    """Groups of neighbouring points of at most ``limit``: halves along the longest side."""
    waiting, done = [np.arange(len(points))], []
    while waiting:
        part = waiting.pop()
        if len(part) <= limit:
            done.append(part)
            continue
        axis = int(np.ptp(points[part], axis=0).argmax())
        part = part[np.argsort(points[part, axis], kind="stable")]
        half = len(part) // 2
        waiting += [np.sort(part[half:]), np.sort(part[:half])]
    return done


def _areas(vertices: Array, faces: NDArray[np.int64]) -> Array:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)
