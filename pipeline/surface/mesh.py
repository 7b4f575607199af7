"""Triangle meshes from a distance field, with small pieces removed and vertex colours."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from pipeline.surface.depth import DepthMap, DepthMaps
from pipeline.surface.simplify import simplify
from pipeline.surface.tsdf import (
    BLOCK,
    Grid,
    Tsdf,
    camera_space,
    choose_grid,
    chunks,
    fuse,
    project_to_pixels,
)

#: Least weight of a voxel: two rendered depths, or one of multi-view stereo, which other views have
#: confirmed.
MIN_WEIGHT = 2.0
#: Connected pieces with a smaller share of the triangles are removed as floaters.
SMALL_PIECE = 0.002

# Side in blocks of the chunks that marching cubes processes.
_CHUNK = 8
_VERTICES = 1 << 16


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) float32, world.
        faces: (F, 3) int32, counter-clockwise seen from outside.
        normals: (V, 3) float32, unit length, pointing outwards.
        colors: (V, 3) uint8, sRGB.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8]

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices):,} vertices, {len(self.faces):,} triangles)"


def extract(field: Tsdf, min_weight: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Marching cubes (Lewiner et al. 2003) over cells whose corners were all observed.

    Args:
        min_weight: Voxels of less weight are treated as unobserved.

    Returns:
        vertices (V, 3) float64, world, with at most one per grid edge; faces (F, 3).
    """
    grid, side = field.grid, _CHUNK * BLOCK + 1
    parts: list[NDArray[np.float64]] = []
    faces: list[NDArray[np.int64]] = []
    count = 0
    for first, rows in chunks(grid, _CHUNK):
        values, observed = np.ones((side,) * 3, np.float32), np.zeros((side,) * 3, bool)
        for row, at in zip(rows, (grid.blocks[rows] - first) * BLOCK, strict=True):
            size = np.minimum(BLOCK, side - at)
            target = tuple(slice(a, a + n) for a, n in zip(at, size, strict=True))
            source = (row, *(slice(0, n) for n in size))
            values[target], observed[target] = (
                field.distance[source],
                field.weight[source] >= min_weight,
            )
        # A zero would put a vertex on a grid corner, shared by several edges.
        values[values == 0] = 1e-6
        # skimage's mask indexes a cell by its last corner.
        cells = np.zeros_like(observed)
        corners = [slice(0, -1), slice(1, None)]
        cells[1:, 1:, 1:] = np.logical_and.reduce(
            [observed[i, j, k] for i in corners for j in corners for k in corners]
        )
        below = values < 0
        if not (cells.any() and below[observed].any() and not below[observed].all()):
            continue
        try:
            points, triangles, *_ = marching_cubes(values, 0.0, mask=cells)
        except RuntimeError:  # no surface in the observed cells
            continue
        parts.append(points.astype(np.float64) + first * BLOCK)
        faces.append(triangles.astype(np.int64) + count)
        count += len(points)
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    vertices, triangles = _weld(np.concatenate(parts), np.concatenate(faces))
    return vertices * grid.voxel, triangles


def _weld(
    vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Merge the vertices of different chunks on the same grid edge; voxel units."""
    base = np.floor(vertices).astype(np.int64)
    # Axis of the grid edge that the vertex lies on; 3 for vertices inside a cell.
    loose = vertices != base
    axis = np.where(loose.sum(axis=1) == 1, loose.argmax(axis=1), 3)
    inner = np.where(axis == 3, np.arange(len(vertices)), -1)
    keys = np.column_stack([base, axis, inner])
    order = np.lexsort(keys.T)
    new = np.ones(len(order), bool)
    new[1:] = np.any(keys[order[1:]] != keys[order[:-1]], axis=1)
    target = np.empty(len(order), np.int64)
    target[order] = np.cumsum(new) - 1
    faces = target[faces]
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return vertices[order[new]], faces[distinct]


def remove_small_pieces(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], min_faces: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Remove connected pieces of fewer than ``min_faces`` triangles, and unused vertices."""
    count = len(vertices)
    links = coo_matrix(
        (np.ones(2 * len(faces), np.int8), (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())),
        shape=(count, count),
    )
    _, piece = connected_components(links, directed=False)
    size = np.bincount(piece[faces[:, 0]], minlength=int(piece.max(initial=0)) + 1)
    faces = faces[size[piece[faces[:, 0]]] >= min_faces]
    used = np.zeros(count, bool)
    used[faces] = True
    return vertices[used], (np.cumsum(used) - 1)[faces]


def vertex_normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """(V, 3) unit normals: area-weighted means of the normals of adjacent triangles."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    total = np.stack(
        [np.bincount(faces.ravel(), np.repeat(cross[:, i], 3), len(vertices)) for i in range(3)],
        axis=1,
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(np.where(length > 0, total / np.maximum(length, 1e-300), (0.0, 0.0, 1.0)))


def vertex_colors(
    vertices: NDArray[np.float64],
    normals: NDArray[np.float64],
    depths: Iterable[DepthMap],
    tolerance: float,
    threads: int,
) -> NDArray[np.uint8]:
    """(V, 3) uint8 mean colour over the views that see the vertex, weighted by the squared cosine
    of the viewing angle; grey if none does.

    Args:
        tolerance: The largest difference of depths for a vertex to be visible, world units.
    """
    total, weight = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    parts = [slice(i, i + _VERTICES) for i in range(0, len(vertices), _VERTICES)]

    def add(depth: DepthMap, part: slice) -> None:
        view, normal = depth.view, normals[part]
        x, y, z = camera_space(view, vertices[part])
        pixel, seen = project_to_pixels(view, x, y, z)
        found = depth.depth.reshape(-1)[pixel]
        ray = vertices[part] - view.centre
        facing = -(ray * normal).sum(axis=1) / np.maximum(np.linalg.norm(ray, axis=1), 1e-12)
        contribution = np.where(
            seen & (np.abs(found - z) < tolerance), np.clip(facing, 0, 1) ** 2, 0.0
        )
        weight[part] += contribution
        total[part] += contribution[:, None] * depth.rgb.reshape(-1, 3)[pixel]

    with ThreadPoolExecutor(max(1, threads)) as pool:
        for depth in depths:
            for _ in pool.map(partial(add, depth), parts):
                pass
    mean = total / np.maximum(weight, 1e-12)[:, None]
    return np.where(weight[:, None] > 0, np.rint(mean), 128).astype(np.uint8)


def build_mesh(
    depths: DepthMaps, voxel: float | None, threads: int, count: int | None = None
) -> tuple[Mesh | None, Grid | None]:
    """Fuse depth maps to a mesh; the result is the same bits at any number of threads.

    Args:
        voxel: The side of a voxel, world units; None chooses one (see ``choose_grid``).
        count: The number of triangles; None for ``simplify.SHARE`` of those of marching cubes.

    Returns:
        The mesh and its grid; None if there is no surface.
    """
    grid = choose_grid(depths, voxel)
    if grid is None:
        return None, None
    field = fuse(grid, depths, threads)
    vertices, faces = extract(field, min(MIN_WEIGHT, len(depths)))
    del field
    vertices, faces = remove_small_pieces(vertices, faces, int(np.ceil(SMALL_PIECE * len(faces))))
    if len(faces) == 0:
        return None, grid
    vertices, faces = simplify(vertices, faces, count, grid.voxel)
    normals = vertex_normals(vertices, faces)
    colors = vertex_colors(vertices, normals, depths, grid.truncation, threads)
    mesh = Mesh(
        vertices.astype(np.float32), faces.astype(np.int32), normals.astype(np.float32), colors
    )
    return mesh, grid
