"""Fewer triangles: number, volume, bounds, boundaries, independence of scale and place."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.surface.mesh import build_mesh
from pipeline.surface.simplify import SHARE, simplify
from tests.surface.scenes import ball


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


@pytest.fixture(scope="module")
def sphere():
    mesh, _ = build_mesh(ball(), 0.04, threads=2, count=10**9)
    return mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)


@pytest.mark.parametrize("share", [2, 8, 20])
def test_volume_and_bounds_are_kept(sphere, share):
    vertices, faces = sphere
    count = len(faces) // share
    found, fewer = simplify(vertices, faces, count, 0.04)
    assert abs(len(fewer) - count) <= 2
    assert abs(volume(found, fewer) / volume(vertices, faces) - 1) < 0.01
    assert np.abs(found.min(axis=0) - vertices.min(axis=0)).max() < 0.04
    assert np.abs(found.max(axis=0) - vertices.max(axis=0)).max() < 0.04
    assert set(np.unique(fewer)) == set(range(len(found))), "all vertices are used"


def test_a_plane_keeps_its_boundary_with_few_triangles():
    """The corners and sides of a square with a bumpless inside."""
    side = 20
    row, column = (a.ravel() for a in np.indices((side + 1, side + 1)))
    vertices = np.column_stack([column, row, 0 * row]).astype(float)
    at = (row * (side + 1) + column).reshape(side + 1, side + 1)
    corners = [at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]]
    a, b, c, d = (part.ravel() for part in corners)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([c, d, a], 1)])
    found, fewer = simplify(vertices, faces, 160, 1.0)
    x, y, z = (found[fewer[:, i]] for i in range(3))
    assert np.linalg.norm(np.cross(y - x, z - x), axis=1).sum() / 2 == pytest.approx(400, rel=0.02)
    assert np.array_equal(found.min(axis=0), [0, 0, 0])
    assert np.array_equal(found.max(axis=0), [side, side, 0])


def test_the_default_is_a_share_and_more_changes_nothing(sphere):
    _, fewer = simplify(*sphere, None, 0.04)
    assert len(fewer) == pytest.approx(SHARE * len(sphere[1]), abs=3)
    assert simplify(*sphere, 10**9, 0.04)[1] is sphere[1]


def test_scale_and_place_have_no_influence(sphere):
    vertices, faces = sphere
    found, fewer = simplify(vertices, faces, 600, 0.04)
    far, same = simplify(1024 * vertices + 512, faces, 600, 1024 * 0.04)
    assert len(same) == len(fewer)
    assert volume(far - 512, same) / 1024**3 == pytest.approx(volume(found, fewer), rel=1e-3)
