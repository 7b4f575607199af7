"""Proposals go where photographs are missing, where there is room, and say so in words."""

import numpy as np
import pytest

from pipeline.coverage.probe_views import open_eye
from pipeline.coverage.summary import describe
from pipeline.coverage.viewpoints import Viewpoint, propose
from pipeline.splats.gaussians import Gaussians, concat
from tests.coverage.room import UP, blobs, camera, drawer, wall

DISTANCE = 4.0


def ball() -> Gaussians:
    """Of many small balls, about the origin, and a floor below."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(600, 3))
    points *= 1.2 / np.linalg.norm(points, axis=1, keepdims=True)
    ring = rng.uniform(-5, 5, (2500, 2))
    floor = [(float(x), 1.3, float(z)) for x, z in ring]
    return concat([blobs([tuple(p) for p in points.tolist()]), blobs(floor)])


def around(degrees) -> list:
    return [
        camera(
            f"{d:03d}.jpg",
            (DISTANCE * np.sin(np.radians(d)), -0.8, -DISTANCE * np.cos(np.radians(d))),
            (0, 0, 0),
        )
        for d in degrees
    ]


@pytest.fixture(scope="module")
def gap():
    """An orbit that leaves out 90 to 180 degrees."""
    scene = ball()
    views = around(range(180, 451, 15))
    draw = drawer(scene)
    eyes = [open_eye(view, draw) for view in views]
    return views, eyes, propose(views, eyes, draw, UP, 10.0)


def azimuth(place) -> float:
    return float(np.degrees(np.arctan2(place[0], -place[2])) % 360)


def test_the_gap_is_found_first(gap) -> None:
    _, _, outlook = gap
    first, second = (azimuth(p.viewpoint.view.centre) for p in outlook.proposals[:2])
    assert 100 < first < 170, first
    assert 90 < second < 180 and abs(first - second) > 15, second
    assert outlook.before < outlook.after <= 1


def test_gains_fall_and_add_up(gap) -> None:
    _, _, outlook = gap
    gains = [p.gain for p in outlook.proposals]
    assert all(gain > 0 for gain in gains)
    assert gains[0] == max(gains)
    assert sum(gains) == pytest.approx(outlook.after - outlook.before, rel=1e-3)
    assert outlook.proposals[0].unknown > 0.3


def test_viewpoints_stay_on_the_shell_and_look_at_the_subject(gap) -> None:
    views, _, outlook = gap
    heights = [view.centre @ UP for view in views]
    for viewpoint in outlook.judged:
        place = viewpoint.view.centre
        assert 0.5 * DISTANCE < np.linalg.norm(place) < 1.5 * DISTANCE
        assert min(heights) - 0.11 * DISTANCE <= place @ UP <= max(heights) + 0.11 * DISTANCE
        towards = viewpoint.subject - place
        ahead = viewpoint.view.world_to_camera[2, :3]
        assert ahead @ towards == pytest.approx(np.linalg.norm(towards), rel=1e-6)


def test_no_viewpoint_is_behind_a_wall() -> None:
    """Beside the cameras, a wall that they see stands where moving around would lead."""
    ahead = wall((-4, 4), (-2, 2), 4.0)
    columns = np.stack(np.meshgrid(np.arange(-2, 2, 0.1), np.arange(0, 4, 0.1)), -1).reshape(-1, 2)
    side = blobs([(1.2, float(y), float(z)) for y, z in columns], 0.08)
    draw = drawer(concat([ahead, side]))
    views = [camera(f"{i}.jpg", (0.1 * i, 0, -1), (0.3, 0, 4)) for i in range(3)]
    outlook = propose(views, [open_eye(view, draw) for view in views], draw, UP, 8.0)
    assert outlook.judged
    for viewpoint in outlook.judged:
        x, _, z = viewpoint.view.centre
        assert x < 1.2 or z < 0, viewpoint.view.centre


def test_one_view_and_no_surface_are_no_error() -> None:
    draw = drawer(wall())
    views = [camera("only.jpg", (0, 0, 0))]
    outlook = propose(views, [open_eye(view, draw) for view in views], draw, UP, 8.0)
    assert len(outlook.proposals) <= 5
    away = [camera("away.jpg", (0, 0, 8))]
    eyes = [open_eye(view, draw) for view in away]
    assert propose(away, eyes, draw, UP, 8.0).proposals == []


def test_what_is_known_all_over_needs_nothing() -> None:
    """Photographs from every direction at every height leave little to gain."""
    draw = drawer(ball())
    views = around(range(0, 360, 6))
    eyes = [open_eye(view, draw) for view in views]
    assert propose(views, eyes, draw, UP, 10.0).before > 0.6


def test_words_name_the_cameras_on_both_sides_and_the_step(gap) -> None:
    _, eyes, _ = gap
    (view,) = around([188])
    raised = camera("x", tuple(view.centre + 0.6 * UP), (0, 0, 0))
    viewpoint = Viewpoint(raised, np.zeros(3), DISTANCE)
    text = describe(viewpoint, eyes, UP, "m")
    assert text.startswith(("between 195.jpg and 180.jpg, 0.6", "between 180.jpg and 195.jpg, 0.6"))
    assert "m higher" in text and "left" not in text
    assert "15% higher (of the distance to the subject)" in describe(viewpoint, eyes, UP, None)


def test_words_say_left_and_right_as_the_person_sees_it() -> None:
    draw = drawer(wall())
    eyes = [open_eye(camera("one.jpg", (0, 0, 0)), draw)]
    # Looking along z with -y up, x is to the right.
    for x, side in ((1.0, "right"), (-1.0, "left")):
        viewpoint = Viewpoint(camera("x", (x, 0.0, -0.8)), np.array([0, 0, 4.0]), 4.0)
        text = describe(viewpoint, eyes, UP, "m")
        assert text == (
            f"from one.jpg, 1 m to the {side}, 0.8 m back, looking at what one.jpg shows in its "
            "middle"
        )
