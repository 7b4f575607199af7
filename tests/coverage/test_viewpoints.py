"""Proposed viewpoints: in gaps of the coverage, at free places, with a description."""

import numpy as np
import pytest

from pipeline.coverage.probe_views import render_probe
from pipeline.coverage.summary import describe
from pipeline.coverage.viewpoints import Viewpoint, propose_viewpoints
from pipeline.splats.gaussians import Gaussians, concat
from tests.coverage.scenes import UP, blobs, camera, renderer, wall

DISTANCE = 4.0


def ball() -> Gaussians:
    """A sphere of small blobs around the origin, above a floor."""
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
    """An orbit without the azimuths from 90 to 180 degrees."""
    scene = ball()
    views = around(range(180, 451, 15))
    render = renderer(scene)
    probes = [render_probe(view, render) for view in views]
    return views, probes, propose_viewpoints(views, probes, render, UP, 10.0)


def azimuth(place) -> float:
    return float(np.degrees(np.arctan2(place[0], -place[2])) % 360)


def test_proposals_fill_the_gap_first(gap) -> None:
    _, _, best = gap
    first, second = (azimuth(p.viewpoint.view.centre) for p in best.proposals[:2])
    assert 100 < first < 170, first
    assert 90 < second < 180 and abs(first - second) > 15, second
    assert best.trust_before < best.trust_after <= 1


def test_gains_are_positive_and_add_up(gap) -> None:
    _, _, best = gap
    gains = [p.gain for p in best.proposals]
    assert all(gain > 0 for gain in gains)
    assert gains[0] == max(gains)
    assert sum(gains) == pytest.approx(best.trust_after - best.trust_before, rel=1e-3)
    assert best.proposals[0].unknown > 0.3


def test_candidates_keep_their_distance_and_face_the_subject(gap) -> None:
    views, _, best = gap
    heights = [view.centre @ UP for view in views]
    for viewpoint in best.candidates:
        place = viewpoint.view.centre
        assert 0.5 * DISTANCE < np.linalg.norm(place) < 1.5 * DISTANCE
        assert min(heights) - 0.11 * DISTANCE <= place @ UP <= max(heights) + 0.11 * DISTANCE
        to_subject = viewpoint.subject - place
        ahead = viewpoint.view.world_to_camera[2, :3]
        assert ahead @ to_subject == pytest.approx(np.linalg.norm(to_subject), rel=1e-6)


def test_no_candidate_is_behind_a_wall() -> None:
    """A wall beside the cameras stands on the orbit around the subject."""
    ahead = wall((-4, 4), (-2, 2), 4.0)
    columns = np.stack(np.meshgrid(np.arange(-2, 2, 0.1), np.arange(0, 4, 0.1)), -1).reshape(-1, 2)
    side = blobs([(1.2, float(y), float(z)) for y, z in columns], 0.08)
    render = renderer(concat([ahead, side]))
    views = [camera(f"{i}.jpg", (0.1 * i, 0, -1), (0.3, 0, 4)) for i in range(3)]
    best = propose_viewpoints(
        views, [render_probe(view, render) for view in views], render, UP, 8.0
    )
    assert best.candidates
    for viewpoint in best.candidates:
        x, _, z = viewpoint.view.centre
        assert x < 1.2 or z < 0, viewpoint.view.centre


def test_a_single_view_and_no_surface_are_accepted() -> None:
    render = renderer(wall())
    views = [camera("only.jpg", (0, 0, 0))]
    best = propose_viewpoints(
        views, [render_probe(view, render) for view in views], render, UP, 8.0
    )
    assert len(best.proposals) <= 5
    away = [camera("away.jpg", (0, 0, 8))]
    probes = [render_probe(view, render) for view in away]
    assert propose_viewpoints(away, probes, render, UP, 8.0).proposals == []


def test_full_coverage_has_high_trust() -> None:
    """A dense orbit leaves little to gain."""
    render = renderer(ball())
    views = around(range(0, 360, 6))
    probes = [render_probe(view, render) for view in views]
    assert propose_viewpoints(views, probes, render, UP, 10.0).trust_before > 0.6


def test_description_names_the_neighbouring_cameras_and_the_offset(gap) -> None:
    _, probes, _ = gap
    (view,) = around([188])
    raised = camera("x", tuple(view.centre + 0.6 * UP), (0, 0, 0))
    viewpoint = Viewpoint(raised, np.zeros(3), DISTANCE)
    text = describe(viewpoint, probes, UP, "m")
    assert text.startswith(("between 195.jpg and 180.jpg, 0.6", "between 180.jpg and 195.jpg, 0.6"))
    assert "m higher" in text and "left" not in text
    assert "15% higher (of the distance to the subject)" in describe(viewpoint, probes, UP, None)


def test_description_has_left_and_right_of_the_photographer() -> None:
    render = renderer(wall())
    probes = [render_probe(camera("one.jpg", (0, 0, 0)), render)]
    # Looking along z with -y up, x is to the right.
    for x, side in ((1.0, "right"), (-1.0, "left")):
        viewpoint = Viewpoint(camera("x", (x, 0.0, -0.8)), np.array([0, 0, 4.0]), 4.0)
        text = describe(viewpoint, probes, UP, "m")
        assert text == (
            f"from one.jpg, 1 m to the {side}, 0.8 m back, looking at what one.jpg shows in its "
            "middle"
        )
