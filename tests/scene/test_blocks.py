"""Boxes fill space without overlap, and separate what is in front of them from what is behind."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.scene.blocks import Box

Array = NDArray[np.float64]
coordinates = st.floats(-10, 10).map(lambda value: round(value, 3))


def box(lower: Array, upper: Array, axes: Array | None = None) -> Box:
    return Box(np.eye(3) if axes is None else axes, lower, upper)


def sampled(space: Box, start: Array, end: Array) -> bool:
    """Whether one of many points of the segment is in the box."""
    t = np.linspace(0, 1, 2001)[:, None]
    return bool(space.contains(start + t * (end - start)).any())


@given(arrays(float, 3, elements=coordinates), arrays(float, 3, elements=coordinates))
def test_a_segment_meets_a_box_if_one_of_its_points_is_inside(start: Array, end: Array) -> None:
    space = box(np.array([-2.0, -np.inf, 0.5]), np.array([3.0, 4.0, np.inf]))
    if sampled(space, start, end):
        assert space.between(start, end[None])[0]


@given(arrays(float, 3, elements=coordinates), arrays(float, 3, elements=coordinates))
def test_a_segment_that_meets_a_box_comes_close_to_its_inside(start: Array, end: Array) -> None:
    space = box(np.array([-2.0, -np.inf, 0.5]), np.array([3.0, 4.0, np.inf]))
    grown = space.expanded(np.full(3, 0.02), np.full(3, 0.02))
    if space.between(start, end[None])[0]:
        assert sampled(grown, start, end)


def test_halves_of_a_box_share_no_point_and_lose_none() -> None:
    rng = np.random.default_rng(0)
    points = np.round(rng.normal(size=(500, 3)), 1)  # many are exactly on the face
    axes = quat_to_rotation(np.array([0.9, 0.1, 0.3, -0.2]))
    infinite = np.full(3, np.inf)
    face = np.array([np.inf, 0.3, np.inf])
    below, above = box(-infinite, face, axes), box(-np.abs(face) * [1, -1, 1], infinite, axes)
    assert (below.contains(points) ^ above.contains(points)).all()


def test_a_camera_inside_has_everything_else_behind_the_box() -> None:
    space = box(np.full(3, -1.0), np.full(3, 1.0))
    assert space.between(np.zeros(3), np.array([[5.0, 0, 0], [0, -3, 0]])).all()
