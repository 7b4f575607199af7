"""Who sees a point, and how far a view of it is to be trusted."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from pipeline.coverage.defects import floating, holes, near_floaters
from pipeline.coverage.probe_views import Points, look_for, open_eye, points_of
from pipeline.coverage.trust import gather, trust, trust_picture
from pipeline.splats.gaussians import concat
from tests.coverage.room import blobs, camera, drawer, wall

# On the wall: seen by three cameras, by one, by none.
PLACES = np.array([[0.0, 0.0, 4.0], [2.6, 0.0, 4.0], [-3.6, 0.0, 4.0]])
CAMERAS = [camera("a", (0, 0, 0)), camera("b", (-0.5, 0, 0)), camera("c", (1, 0, 0))]


def asked_from(centre, xyz=PLACES, focal=60.0) -> Points:
    offset = np.asarray(centre, float) - xyz
    towards = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    sharpness = np.full(len(xyz), focal / 4.0, np.float32)
    return Points(xyz, np.zeros(len(xyz), bool), towards.astype(np.float32), sharpness)


def trusted(eyes, points) -> np.ndarray:
    found = gather(eyes, points)
    return trust(found.information, found.support, points.towards)


def test_a_wall_seen_by_three_by_one_and_by_none() -> None:
    draw = drawer(wall())
    eyes = [open_eye(view, draw) for view in CAMERAS]
    evidence = gather(eyes, asked_from((0, 0, 0)))
    assert evidence.count.tolist() == [3, 1, 0]
    # From a to c the directions to the middle differ by atan(1/4), and b lies on the other side.
    assert evidence.parallax[0] == pytest.approx(np.degrees(np.arctan(1 / 4)), abs=0.1)
    assert evidence.parallax[1:].tolist() == [0, 0]
    middle, side, beyond = trusted(eyes, asked_from((0, 0, 0)))
    assert middle > side > beyond == 0
    assert middle > 0.5


def test_a_thing_in_front_hides_what_is_behind_it() -> None:
    screen = wall((-1, 1), (-1, 1), 2.0)
    eye = open_eye(camera("a", (0, 0, 0)), drawer(concat([wall(), screen])))
    behind, on, before = (np.array([[0.0, 0.0, z]]) for z in (4.0, 2.0, 1.0))
    shut = np.zeros(1, bool)
    assert look_for(eye, behind, shut).hidden.all()
    assert look_for(eye, on, shut).seen.tolist() == [0]
    assert look_for(eye, before, shut).passed.all()
    out_of_picture = look_for(eye, np.array([[9.0, 0.0, 4.0], [0.0, 0.0, -4.0]]), np.zeros(2, bool))
    assert not len(out_of_picture.seen)
    assert not (out_of_picture.hidden | out_of_picture.passed).any()


def test_an_unknown_depth_costs_nothing_seen_from_the_photograph_and_much_from_the_side() -> None:
    eyes = [open_eye(camera("a", (0, 0, 0)), drawer(wall()))]
    place = PLACES[:1]
    same, side = (trusted(eyes, asked_from(c, place))[0] for c in ((0, 0, 0), (1.5, 0, 0)))
    assert same == pytest.approx(0.5, abs=0.02)  # one photograph, from the very place
    assert side < 0.1 * same
    # A second photograph from elsewhere gives the depth.
    both = [*eyes, open_eye(camera("c", (0, 0.8, 0)), drawer(wall()))]
    assert trusted(both, asked_from((1.5, 0, 0), place))[0] > 4 * side


def test_a_closer_look_than_any_photograph_is_trusted_less() -> None:
    eyes = [open_eye(view, drawer(wall())) for view in CAMERAS]
    sharp = [trusted(eyes, asked_from((0, 0, 0), PLACES[:1], f))[0] for f in (30, 60, 240)]
    assert sharp[0] >= sharp[1] > 3 * sharp[2]


def test_masked_pixels_saw_nothing(tmp_path) -> None:
    mask = np.full((60, 60), 255, np.uint8)
    mask[:, 25:35] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    view = replace(CAMERAS[0], mask=str(tmp_path / "mask.png"))
    eye = open_eye(view, drawer(wall()))
    assert gather([eye], asked_from((0, 0, 0))).count[0] == 0
    assert gather([eye], asked_from((0, 0, 0), np.array([[1.0, 0, 4.0]]))).count[0] == 1


def test_the_world_may_be_tiny_far_away_and_of_any_unit() -> None:
    """A similarity of the world changes no trust."""
    view, scale, shift = CAMERAS[2], 1e-3, np.array([3e4, -1e4, 2e4])
    eyes = [open_eye(v, drawer(wall())) for v in CAMERAS]
    plain = points_of(eyes[2], 8.0)

    def moved(eye):
        pose = eye.view.world_to_camera.copy()
        centre = scale * eye.view.centre + shift
        pose[:3, 3] = -pose[:3, :3] @ centre
        return replace(
            eye,
            view=replace(eye.view, world_to_camera=pose),
            depth=eye.depth * np.float32(scale),
            near=eye.near * np.float32(scale),
            far=eye.far * np.float32(scale),
        )

    others = [moved(eye) for eye in eyes]
    found = trusted(others[:2], points_of(others[2], 8.0 * scale))
    assert np.abs(found - trusted(eyes[:2], plain)).mean() < 1e-3, view.name


def test_emptiness_that_photographs_agree_on_is_no_hole() -> None:
    """The background of an object photographed alone is known; a gap seen by none is not."""
    draw = drawer(wall((-1, 1), (-1, 1)))
    eyes = [open_eye(view, draw) for view in CAMERAS]
    inside = open_eye(camera("q", (0.2, 0, 0)), draw)
    picture, evidence = trust_picture(inside, eyes, 20.0)
    found = holes(inside, evidence, None)
    assert inside.open.mean() > 0.5 and found.mean() < 0.1
    assert picture[inside.open & ~found].min() > 0.2
    aside = open_eye(camera("q", (6, 0, 0)), draw)
    _, evidence = trust_picture(aside, eyes, 20.0)
    assert holes(aside, evidence, None).mean() > 0.5
    # A photograph with alpha says itself where something is.
    opaque = np.ones(inside.depth.shape, bool)
    _, evidence = trust_picture(inside, eyes, 20.0)
    assert np.array_equal(holes(inside, evidence, opaque), inside.open)


def test_floaters_are_found_where_photographs_see_past_them() -> None:
    scene = concat([wall(), blobs([(0.25, 0.1, 1.6)])])
    # Only a has it before it; the others look past where it is.
    eyes = [open_eye(v, drawer(scene if v.name == "a" else wall())) for v in CAMERAS]
    found = near_floaters(scene, eyes, [], 4.0)
    assert (found.count, found.cameras) == (1, {"a": 1})
    held_out = near_floaters(scene, eyes[1:], eyes[:1], 4.0)
    assert (held_out.count, held_out.cameras) == (1, {"a": 1})
    assert near_floaters(wall(), eyes, [], 4.0).count == 0
    # Three that see it agree that it is there.
    agreeing = [open_eye(view, drawer(scene)) for view in CAMERAS]
    assert near_floaters(scene, agreeing, [], 4.0).count == 0
    picture, evidence = trust_picture(eyes[0], eyes[1:], 8.0)
    shown = floating(eyes[0], evidence, 4.0)
    assert 0 < shown.mean() < 0.3
    assert picture[shown].max() < 0.05 < np.median(picture[~shown])


def test_threads_change_nothing() -> None:
    pictures = []
    for threads in (1, 3):
        draw = drawer(wall(), threads)
        eyes = [open_eye(view, draw) for view in CAMERAS]
        pictures.append(trust_picture(eyes[0], eyes[1:], 8.0)[0])
    assert np.array_equal(*pictures)
