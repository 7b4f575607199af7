"""The rasterizer of triangles: coverage, depth order, independence of the order."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.surface.triangles import barycentric, draw_triangles

#: Two triangles of a square in the image, and one in front of a part of it.
SQUARE = np.array([[1.0, 1], [9, 1], [9, 7], [1, 7], [4, 2], [8, 2], [4, 6]])
FACES = np.array([[0, 1, 2], [2, 3, 0], [4, 5, 6]])
NEAR = np.array([1.0, 1, 1, 1, 2, 2, 2])


def test_triangles_with_a_common_edge_cover_each_pixel_once():
    drawn = draw_triangles(SQUARE, NEAR, FACES[:2], 10, 8)
    expected = np.zeros((8, 10), bool)
    expected[1:7, 1:9] = True
    assert np.array_equal(drawn.face >= 0, expected)
    assert {0, 1} == set(drawn.face[expected].tolist())
    assert np.array_equal(drawn.inverse_depth[expected], np.ones(48, np.float32))


def test_the_nearest_triangle_is_seen_in_any_order():
    first = draw_triangles(SQUARE, NEAR, FACES, 10, 8)
    # Centres on the hypotenuse belong to its other side.
    assert (first.face == 2).sum() == 3 + 2 + 1
    order = [2, 1, 0]
    again = draw_triangles(SQUARE, NEAR, FACES[order], 10, 8)
    assert np.array_equal(np.where(again.face >= 0, np.array(order)[again.face], -1), first.face)
    assert np.array_equal(again.inverse_depth, first.inverse_depth)


def test_depth_is_that_of_the_plane():
    """1 / z is affine in the image."""
    xy = np.array([[0.0, 0], [40, 0], [0, 40]])
    inverse = np.array([0.5, 0.9, 0.1])
    drawn = draw_triangles(xy, inverse, np.array([[0, 1, 2]]), 40, 40)
    row, column = np.nonzero(drawn.face == 0)
    expected = 0.5 + 0.4 * (column + 0.5) / 40 - 0.4 * (row + 0.5) / 40
    assert len(row) > 700
    assert np.allclose(drawn.inverse_depth[row, column], expected, atol=1e-6)


def test_triangles_behind_the_camera_and_outside_are_not_drawn():
    xy = np.array([[0.0, 0], [5, 0], [0, 5], [100, 100], [105, 100], [100, 105]])
    inverse = np.array([1.0, 1, 0, 1, 1, 1])
    drawn = draw_triangles(xy, inverse, np.array([[0, 1, 2], [3, 4, 5]]), 8, 8)
    assert (drawn.face == -1).all() and not drawn.inverse_depth.any()


@given(arrays(np.float64, (6, 2), elements=st.floats(-20, 40)))
@settings(max_examples=60, deadline=None)
def test_covered_pixels_are_inside(xy):
    """All centres that are clearly inside are covered, and none that is clearly outside."""
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    drawn = draw_triangles(xy, np.array([1.0, 1, 1, 2, 2, 2]), faces, 24, 16)
    row, column = (a.ravel() for a in np.indices((16, 24)))
    points = np.column_stack([column, row]) + 0.5
    for number, face in enumerate(faces):
        a, b, c = xy[face]
        signed = []
        for p, q in ((a, b), (b, c), (c, a)):
            edge = q - p
            length = max(float(np.hypot(*edge)), 1e-9)
            signed.append((edge[0] * (points - p)[:, 1] - edge[1] * (points - p)[:, 0]) / length)
        low, high = np.min(signed, axis=0), np.max(signed, axis=0)
        inside, outside = (low > 1e-6) | (high < -1e-6), (low < -1e-6) & (high > 1e-6)
        found = drawn.face.ravel()
        assert not (found[outside] == number).any()
        assert (found[inside] >= number).all()


def test_barycentric_coordinates_give_the_point():
    rng = np.random.default_rng(0)
    corners = rng.random((50, 3, 2))
    weights = rng.dirichlet((1, 1, 1), 50)
    points = (weights[..., None] * corners).sum(axis=1)
    assert np.allclose(barycentric(corners, points), weights, atol=1e-9)
