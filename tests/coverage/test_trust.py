"""Visibility of points, trust, holes and floaters."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from pipeline.coverage.defects import floating, holes, near_floaters
from pipeline.coverage.probe_views import QueryPoints, backproject, find_visible, render_probe
from pipeline.coverage.trust import collect_observations, trust, trust_map
from pipeline.splats.gaussians import concat
from tests.coverage.scenes import blobs, camera, renderer, wall

# Points on the wall, seen by three cameras, by one and by none.
POINTS = np.array([[0.0, 0.0, 4.0], [2.6, 0.0, 4.0], [-3.6, 0.0, 4.0]])
CAMERAS = [camera("a", (0, 0, 0)), camera("b", (-0.5, 0, 0)), camera("c", (1, 0, 0))]


def points_from(centre, xyz=POINTS, focal=60.0) -> QueryPoints:
    offset = np.asarray(centre, float) - xyz
    to_camera = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    resolution = np.full(len(xyz), focal / 4.0, np.float32)
    return QueryPoints(xyz, np.zeros(len(xyz), bool), to_camera.astype(np.float32), resolution)


def trust_of(probes, points) -> np.ndarray:
    found = collect_observations(probes, points)
    return trust(found.information, found.support, points.to_camera)


def test_points_seen_by_three_cameras_by_one_and_by_none() -> None:
    render = renderer(wall())
    probes = [render_probe(view, render) for view in CAMERAS]
    observed = collect_observations(probes, points_from((0, 0, 0)))
    assert observed.count.tolist() == [3, 1, 0]
    # From a to c the directions to the middle differ by atan(1/4), and b lies on the other side.
    assert observed.parallax[0] == pytest.approx(np.degrees(np.arctan(1 / 4)), abs=0.1)
    assert observed.parallax[1:].tolist() == [0, 0]
    middle, side, unseen = trust_of(probes, points_from((0, 0, 0)))
    assert middle > side > unseen == 0
    assert middle > 0.5


def test_a_surface_occludes_points_behind_it() -> None:
    screen = wall((-1, 1), (-1, 1), 2.0)
    probe = render_probe(camera("a", (0, 0, 0)), renderer(concat([wall(), screen])))
    behind, on, before = (np.array([[0.0, 0.0, z]]) for z in (4.0, 2.0, 1.0))
    shut = np.zeros(1, bool)
    assert find_visible(probe, behind, shut).occluded.all()
    assert find_visible(probe, on, shut).visible.tolist() == [0]
    assert find_visible(probe, before, shut).seen_past.all()
    out_of_picture = find_visible(
        probe, np.array([[9.0, 0.0, 4.0], [0.0, 0.0, -4.0]]), np.zeros(2, bool)
    )
    assert not len(out_of_picture.visible)
    assert not (out_of_picture.occluded | out_of_picture.seen_past).any()


def test_uncertain_depth_lowers_trust_from_the_side_only() -> None:
    probes = [render_probe(camera("a", (0, 0, 0)), renderer(wall()))]
    place = POINTS[:1]
    same, side = (trust_of(probes, points_from(c, place))[0] for c in ((0, 0, 0), (1.5, 0, 0)))
    assert same == pytest.approx(0.5, abs=0.02)  # one photograph, same pose
    assert side < 0.1 * same
    # A second photograph determines the depth.
    both = [*probes, render_probe(camera("c", (0, 0.8, 0)), renderer(wall()))]
    assert trust_of(both, points_from((1.5, 0, 0), place))[0] > 4 * side


def test_higher_resolution_than_any_photograph_lowers_trust() -> None:
    probes = [render_probe(view, renderer(wall())) for view in CAMERAS]
    sharp = [trust_of(probes, points_from((0, 0, 0), POINTS[:1], f))[0] for f in (30, 60, 240)]
    assert sharp[0] >= sharp[1] > 3 * sharp[2]


def test_masked_pixels_do_not_count_as_observations(tmp_path) -> None:
    mask = np.full((60, 60), 255, np.uint8)
    mask[:, 25:35] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    view = replace(CAMERAS[0], mask=str(tmp_path / "mask.png"))
    probe = render_probe(view, renderer(wall()))
    assert collect_observations([probe], points_from((0, 0, 0))).count[0] == 0
    assert (
        collect_observations([probe], points_from((0, 0, 0), np.array([[1.0, 0, 4.0]]))).count[0]
        == 1
    )


def test_trust_is_invariant_to_a_similarity_of_the_world() -> None:
    view, scale, shift = CAMERAS[2], 1e-3, np.array([3e4, -1e4, 2e4])
    probes = [render_probe(v, renderer(wall())) for v in CAMERAS]
    plain = backproject(probes[2], 8.0)

    def moved(probe):
        pose = probe.view.world_to_camera.copy()
        centre = scale * probe.view.centre + shift
        pose[:3, 3] = -pose[:3, :3] @ centre
        return replace(
            probe,
            view=replace(probe.view, world_to_camera=pose),
            depth=probe.depth * np.float32(scale),
            min_depth=probe.min_depth * np.float32(scale),
            max_depth=probe.max_depth * np.float32(scale),
        )

    others = [moved(probe) for probe in probes]
    found = trust_of(others[:2], backproject(others[2], 8.0 * scale))
    assert np.abs(found - trust_of(probes[:2], plain)).mean() < 1e-3, view.name


def test_background_that_photographs_agree_on_is_no_hole() -> None:
    """Background that several photographs show is certain; a gap that none shows is a hole."""
    render = renderer(wall((-1, 1), (-1, 1)))
    probes = [render_probe(view, render) for view in CAMERAS]
    inside = render_probe(camera("q", (0.2, 0, 0)), render)
    picture, observed = trust_map(inside, probes, 20.0)
    found = holes(inside, observed, None)
    assert inside.empty.mean() > 0.5 and found.mean() < 0.1
    assert picture[inside.empty & ~found].min() > 0.2
    aside = render_probe(camera("q", (6, 0, 0)), render)
    _, observed = trust_map(aside, probes, 20.0)
    assert holes(aside, observed, None).mean() > 0.5
    # With an alpha channel, the opaque pixels decide.
    opaque = np.ones(inside.depth.shape, bool)
    _, observed = trust_map(inside, probes, 20.0)
    assert np.array_equal(holes(inside, observed, opaque), inside.empty)


def test_floaters_are_what_other_photographs_see_past() -> None:
    scene = concat([wall(), blobs([(0.25, 0.1, 1.6)])])
    # Only camera a renders the floater; the others see past it.
    probes = [render_probe(v, renderer(scene if v.name == "a" else wall())) for v in CAMERAS]
    found = near_floaters(scene, probes, [], 4.0)
    assert (found.count, found.cameras) == (1, {"a": 1})
    in_test_view = near_floaters(scene, probes[1:], probes[:1], 4.0)
    assert (in_test_view.count, in_test_view.cameras) == (1, {"a": 1})
    assert near_floaters(wall(), probes, [], 4.0).count == 0
    # Three cameras that see it: a surface.
    agreeing = [render_probe(view, renderer(scene)) for view in CAMERAS]
    assert near_floaters(scene, agreeing, [], 4.0).count == 0
    picture, observed = trust_map(probes[0], probes[1:], 8.0)
    shown = floating(probes[0], observed, 4.0)
    assert 0 < shown.mean() < 0.3
    assert picture[shown].max() < 0.05 < np.median(picture[~shown])


def test_trust_is_independent_of_threads() -> None:
    pictures = []
    for threads in (1, 3):
        render = renderer(wall(), threads)
        probes = [render_probe(view, render) for view in CAMERAS]
        pictures.append(trust_map(probes[0], probes[1:], 8.0)[0])
    assert np.array_equal(*pictures)
