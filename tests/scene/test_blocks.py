"""Boxes fill space without overlap, and separate what is in front of them from what is behind."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.scene.blocks import BlockView, Box

Array = NDArray[np.float64]
coordinates = st.floats(-10, 10).map(lambda value: round(value, 3))


def box(lower: Array, upper: Array, axes: Array | None = None) -> Box:
    return Box(np.eye(3) if axes is None else axes, lower, upper)


def sampled(space: Box, start: Array, end: Array) -> bool:
    """Whether one of many points of the segment is in the box."""
    t = np.linspace(0, 1, 2001)[:, None]
    return bool(space.contains(start + t * (end - start)).any())


SPACE = box(np.array([-2.0, -np.inf, 0.5]), np.array([3.0, 4.0, np.inf]))
places = arrays(float, 3, elements=coordinates)


@example(np.zeros(3), np.array([0.0, 4.0, 1.0]))
@given(places, places)
def test_a_box_hides_what_is_behind_it(camera: Array, point: Array) -> None:
    # A point on the face that belongs to the next box is as near as the box itself.
    outside = (np.clip(point, SPACE.lower, SPACE.upper) != point).any()
    if outside and sampled(SPACE, camera, point):
        assert SPACE.hides(camera, point[None])[0]


@given(places, places, st.floats(0.1, 0.9))
def test_a_box_does_not_hide_what_is_in_front_of_it(
    camera: Array, inside: Array, share: float
) -> None:
    point = camera + share * (inside - camera)
    if SPACE.contains(inside[None])[0] and not sampled(SPACE, camera, point):
        assert not SPACE.hides(camera, point[None])[0]


def test_a_box_hides_the_far_field_beside_it() -> None:
    """The sky over a box: large Gaussians, parts of which are behind it in the image."""
    cube = box(np.full(3, -1.0), np.full(3, 1.0))
    camera, sky = np.array([0.0, -9.0, 3.0]), np.array([[40.0, 80.0, 30.0], [0.0, 90.0, 60.0]])
    assert cube.hides(camera, sky).all()


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
    assert space.hides(np.zeros(3), np.array([[5.0, 0, 0], [0, -3, 0]])).all()


@given(places, places, st.lists(st.floats(0, 3), min_size=1, max_size=20))
def test_a_ray_is_in_a_box_between_its_crossings(
    origin: Array, direction: Array, distances: list[float]
) -> None:
    if not direction.any():
        return
    enter, leave = SPACE.crossed(origin, direction[None])
    for distance in distances:
        if min(abs(distance - enter[0]), abs(distance - leave[0])) > 1e-9:
            inside = SPACE.contains((origin + distance * direction)[None])[0]
            assert inside == (enter[0] < distance < leave[0])


def test_a_clipped_box_is_the_intersection() -> None:
    lower, upper = np.array([-1.0, -2.0, -3.0]), np.array([5.0, 6.0, 2.0])
    points = np.random.default_rng(0).uniform(-8, 8, (500, 3))
    both = SPACE.contains(points) & box(lower, upper).contains(points)
    np.testing.assert_array_equal(SPACE.clipped(lower, upper).contains(points), both)


def test_a_window_in_a_smaller_view_holds_no_pixel_beside_it() -> None:
    shown = BlockView(name="a", window=(10, 20, 101, 55), size=(200, 100), share=0.1)
    left, top, right, bottom = shown.window_in(50, 25)
    assert (left, top, right, bottom) == (3, 5, 27, 18)
    assert shown.window_in(200, 100) == (10, 20, 111, 75)
