"""Fusion and meshing of exact depth maps: shape, closedness, colours, memory bound, threads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import pipeline.surface.tsdf as tsdf
from pipeline.surface.mesh import build_mesh, remove_small_pieces
from tests.surface.scenes import Maps, ball, view_at


@pytest.fixture(scope="module")
def maps():
    return ball()


@pytest.fixture(scope="module")
def built(maps):
    mesh, grid = build_mesh(maps, 0.03, threads=2)
    assert mesh is not None
    return mesh, grid


def test_the_mesh_of_a_ball_is_that_ball(built):
    mesh, grid = built
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert np.median(np.abs(radius - 1)) < 0.2 * grid.voxel
    assert np.abs(radius - 1).max() < 2 * grid.voxel
    assert grid.voxel == 0.03


def test_chunks_are_welded_to_one_closed_surface(built):
    """Each edge belongs to two triangles, which run through it in opposite directions."""
    mesh, grid = built
    assert len(np.unique(grid.blocks // 8, axis=0)) > 1, "the ball should span several chunks"
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    key = edges[:, 0].astype(np.int64) * len(mesh.vertices) + edges[:, 1]
    back = edges[:, 1].astype(np.int64) * len(mesh.vertices) + edges[:, 0]
    assert len(np.unique(key)) == len(key)
    assert np.array_equal(np.sort(key), np.sort(back))


def test_triangles_and_normals_face_outwards(built):
    mesh, _ = built
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    across = np.cross(b - a, c - a)
    assert ((across * (a + b + c)).sum(axis=1) > 0).mean() > 0.99
    assert (mesh.normals * mesh.vertices).sum(axis=1).min() > 0.5
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)


def test_vertices_have_the_colours_that_the_views_show(built):
    mesh, _ = built
    right, left = mesh.vertices[:, 0] > 0.1, mesh.vertices[:, 0] < -0.1
    assert np.abs(mesh.colors[right].astype(int) - (200, 0, 0)).max() <= 20
    assert np.abs(mesh.colors[left].astype(int) - (0, 0, 200)).max() <= 20


def test_threads_do_not_change_a_bit(maps, built):
    mesh, _ = build_mesh(maps, 0.03, threads=1)
    for name in ("vertices", "faces", "normals", "colors"):
        assert np.array_equal(getattr(mesh, name), getattr(built[0], name)), name


def test_voxels_grow_until_they_fit(maps, monkeypatch):
    monkeypatch.setattr(tsdf, "MAX_MESH_VOXELS", 300_000)
    mesh, grid = build_mesh(maps, 0.001, threads=1)
    assert grid.voxel > 0.001
    assert len(grid.blocks) * tsdf.BLOCK**3 <= 300_000
    assert np.median(np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1)) < 0.5 * grid.voxel


def test_unobserved_regions_have_no_surface(maps):
    """Masked pixels (depth 0) on one side leave a hole."""
    hidden = []
    for depth in maps:
        red = depth.rgb[..., 0] > 0
        hidden.append(replace(depth, depth=np.where(red, np.float32(0), depth.depth)))
    mesh, _ = build_mesh(Maps(hidden), 0.03, threads=1)
    assert mesh.vertices[:, 0].max() < 0.1
    assert mesh.vertices[:, 0].min() < -0.95


def test_no_depth_no_mesh(maps):
    blank = [replace(depth, depth=np.zeros_like(depth.depth)) for depth in maps]
    assert build_mesh(Maps(blank), None, threads=1) == (None, None)


def test_a_floater_in_one_view_is_removed(maps):
    """The other views see free space there, and the piece is small."""
    first, *rest = maps
    depth = first.depth.copy()
    depth[40:44, 2:6] = 1.5
    mesh, _ = build_mesh(Maps([replace(first, depth=depth), *rest]), 0.03, threads=1)
    assert np.linalg.norm(mesh.vertices, axis=1).max() < 1.1


def test_small_pieces_are_removed_and_faces_reindexed():
    vertices = np.arange(21, dtype=float).reshape(7, 3)
    faces = np.array([[4, 5, 6], [0, 1, 2], [1, 2, 3]])
    kept, triangles = remove_small_pieces(vertices, faces, 2)
    assert np.array_equal(kept, vertices[:4])
    assert np.array_equal(triangles, [[0, 1, 2], [1, 2, 3]])


def test_distant_surfaces_do_not_enlarge_the_voxels(maps):
    """A wall fifty times as far as the ball: grid and mesh contain the ball only."""
    behind = [replace(d, depth=np.where(np.isinf(d.depth), np.float32(150), d.depth)) for d in maps]
    near = [replace(d, depth=np.where(d.depth > 100, np.float32(0), d.depth)) for d in behind]
    with_wall, grid = build_mesh(Maps(behind + near), 0.03, threads=1)
    assert grid.far < 150
    assert np.linalg.norm(with_wall.vertices, axis=1).max() < 1.1


def test_a_camera_inside_the_grid_updates_only_blocks_in_front():
    """Blocks beside and behind a camera between two walls are not projected."""
    maps = []
    for sign in (1.0, -1.0):
        for shift in (-0.2, 0.0, 0.2):
            view = view_at((0, shift, 0), (sign, shift, 0), 64, 40.0)
            flat = np.full((64, 64), 1.0, np.float32)
            maps.append(tsdf.DepthMap(view, flat, np.full((64, 64, 3), 100, np.uint8)))
    mesh, grid = build_mesh(Maps(maps), 0.05, threads=1)
    assert np.abs(np.abs(mesh.vertices[:, 0]) - 1).max() < grid.voxel
