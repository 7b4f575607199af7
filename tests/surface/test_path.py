"""The camera path is smooth and near the photographs, for all kinds of captures."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.config.video import VideoExport
from pipeline.runtime.errors import UserError
from pipeline.surface import path as path_module
from pipeline.surface.path import describe_path
from tests.io.camera_paths import CENTRES, NERFSTUDIO
from tests.surface.scenes import view_at

UP = np.array([0.0, 0.0, 1.0])
THREE_SECONDS = VideoExport(seconds=3)


def camera_path(views, depth, up, video=THREE_SECONDS):
    return path_module.camera_path(views, depth, up, video, np.zeros(3)).views


def ring(degrees, radius=3.0, height=1.0, count=24):
    angles = np.radians(np.linspace(0, degrees, count, endpoint=degrees < 360))
    return [view_at((radius * np.cos(a), radius * np.sin(a), height), (0, 0, 0.2)) for a in angles]


def centres(path):
    return np.stack([view.centre for view in path])


def check_smooth(path, closed=True):
    """Without a jump or a jerk in position or direction, upright."""
    at = centres(path)
    ahead = np.stack([view.world_to_camera[2, :3] for view in path])
    if closed:
        at, ahead = (np.append(values, values[:1], axis=0) for values in (at, ahead))
    length = np.linalg.norm(np.diff(at, axis=0), axis=1)
    assert length.max() < 6 * max(length.mean(), 1e-9)
    assert (np.arccos(np.clip((ahead[1:] * ahead[:-1]).sum(1), -1, 1))).max() < 0.3
    for view in path:
        rotation = view.world_to_camera[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(rotation) > 0
        assert rotation[1] @ UP < 0, "the picture's down points down"


def test_around_a_full_ring():
    path = camera_path(ring(360), 3.0, UP)
    check_smooth(path)
    at = centres(path)
    assert len(path) == 90
    assert np.allclose(np.hypot(at[:, 0], at[:, 1]), 3, atol=0.05)
    assert np.allclose(at[:, 2], 1, atol=0.05)
    angle = np.unwrap(np.arctan2(at[:, 1], at[:, 0]))
    assert abs(angle[-1] - angle[0]) > 2 * np.pi * 0.95


def test_back_and_forth_over_an_arc_and_never_behind_the_subject():
    path = camera_path(ring(120), 3.0, UP)
    check_smooth(path)
    at = centres(path)
    angle = np.degrees(np.arctan2(at[:, 1], at[:, 0]))
    assert angle.min() > 0 and angle.max() < 120
    assert angle.max() - angle.min() > 60


def test_facing_a_wall():
    """Parallel cameras: the focus is on the wall, at the given depth."""
    views = [view_at((-3, y, z), (5, y, z)) for y in (-0.5, 0, 0.5) for z in (-0.2, 0.2)]
    path = camera_path(views, 4.0, UP)
    check_smooth(path)
    at = centres(path)
    assert at[:, 0].max() < -2.5
    assert np.abs(at[:, 1]).max() < 1
    assert np.ptp(at[:, 1]) > 0.2


def test_inside_a_room():
    """Cameras that look outwards are visited in their order."""
    angles = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    views = [
        view_at((0.3 * np.cos(a), 0.3 * np.sin(a), 1), (9 * np.cos(a), 9 * np.sin(a), 1))
        for a in angles
    ]
    path = camera_path(views, 3.0, UP)
    check_smooth(path, closed=False)
    assert np.linalg.norm(centres(path)[:, :2], axis=1).max() < 0.35
    ahead = np.stack([view.world_to_camera[2, :2] for view in path])
    turned = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    assert turned[-1] - turned[0] > np.radians(300)


def test_a_walk_has_constant_speed_without_the_shake_of_the_hand():
    """Some photographs are close together, and each is 2 cm beside the way."""
    rng = np.random.default_rng(0)
    way = np.concatenate([np.linspace(0, 1, 30), np.linspace(1.2, 6, 25)])
    aside = rng.normal(0, 0.02, (len(way), 2))
    views = [view_at((x, y, 1 + z), (x, 9, 1)) for x, (y, z) in zip(way, aside, strict=True)]
    path = camera_path(views, 5.0, UP, VideoExport(path="cameras", seconds=5))
    check_smooth(path, closed=False)
    at = centres(path)
    assert np.allclose(at[[0, -1], 0], [0, 6], atol=0.3), "from the first to the last photograph"
    step = np.linalg.norm(np.diff(at, axis=0), axis=1)
    assert step.max() < 1.2 * step.min()
    assert np.abs(np.diff(at[:, 1:], 2, axis=0)).max() < 0.001, "the path is as shaky as the hand"


def test_an_orbit_leaves_a_wide_gap_out():
    at = centres(camera_path(ring(260), 3.0, UP))
    angle = np.degrees(np.arctan2(at[:, 1], at[:, 0])) % 360
    assert angle.max() < 260


@pytest.mark.parametrize("kind", ["auto", "orbit", "cameras"])
@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_few_views(count, kind):
    views = ring(30, count=count)
    path = camera_path(views, 3.0, UP, VideoExport(seconds=3, path=kind))
    check_smooth(path, closed=kind != "cameras")
    assert np.linalg.norm(centres(path) - centres(views).mean(0), axis=1).max() < 2


def test_cameras_straight_above():
    path = camera_path([view_at((0.01 * i, 0.02, 3), (0, 0, 0)) for i in range(5)], 3.0, UP)
    for view in path:
        assert np.isfinite(view.world_to_camera).all()


@pytest.mark.parametrize(
    ("size", "long_side", "expected"),
    [((97, 64), None, (96, 64)), ((96, 63), 640, (640, 420)), ((31, 96), 48, (14, 48))],
)
def test_frames_have_even_sides_and_the_field_of_view_of_the_views(size, long_side, expected):
    views = [replace(view, width=size[0], height=size[1]) for view in ring(360)]
    video = VideoExport(seconds=2, fps=4, long_side_px=long_side)
    path = path_module.camera_path(views, 3.0, UP, video, np.zeros(3))
    frame = path.views[0]
    assert (frame.width, frame.height) == expected
    assert np.isclose(frame.fx / frame.width, 110 / size[0])
    described = describe_path(path)
    assert len(described.world_to_camera) == 8
    assert np.array_equal(described.world_to_camera[7], path.views[7].world_to_camera)
    assert (described.width, described.height, described.fps) == (*expected, 4)


def named_ring(suffix=".jpg"):
    return [replace(view, name=f"{i}{suffix}") for i, view in enumerate(ring(360))]


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".jpg.png"])
def test_a_spline_meets_the_chosen_cameras_in_their_order(suffix):
    """Undistorted views have other suffixes than their photographs."""
    views = named_ring(suffix)
    video = VideoExport(path=("0.jpg", "3.jpg", "9.jpg", "7.jpg"), seconds=20)
    path = camera_path(views, 3.0, UP, video)
    check_smooth(path, closed=False)
    at = centres(path)
    distances = np.linalg.norm(at[:, None] - centres(views)[[0, 3, 9, 7]], axis=2)
    assert (distances.min(0) < 0.02).all(), "the path misses a chosen camera"
    assert (np.diff(distances.argmin(0)) > 0).all(), "the order is not the one that was chosen"


def test_a_spline_that_ends_where_it_starts_is_a_loop_without_a_corner():
    video = VideoExport(path=("0.jpg", "6.jpg", "12.jpg", "18.jpg", "0.jpg"), seconds=10)
    path = camera_path(named_ring(), 3.0, UP, video)
    at = centres(path)
    first, last = at[1] - at[0], at[-1] - at[-2]
    assert np.allclose(at[0], at[-1], atol=1e-9)
    assert first @ last > 0.99 * np.linalg.norm(first) * np.linalg.norm(last)


@pytest.mark.parametrize(
    ("names", "message"),
    [(("0.jpg", "3.jpgg"), "did you mean 3.jpg"), (("0.jpg", "0.jpg"), "have the same camera")],
)
def test_photographs_that_make_no_path_are_refused(names, message):
    with pytest.raises(UserError, match=message):
        camera_path(named_ring(), 3.0, UP, VideoExport(path=names))


def test_a_video_can_be_repeated_from_its_own_path_at_another_size(tmp_path):
    views = ring(120)
    first = path_module.camera_path(views, 3.0, UP, THREE_SECONDS, np.zeros(3))
    describe_path(first).write(tmp_path)
    video = VideoExport(path=str(tmp_path / "path.json"), long_side_px=48, fps=7)
    again = path_module.camera_path(views[:2], 3.0, UP, video, np.ones(3))
    assert again.fps == first.fps, "the file's rate counts"
    assert (again.views[0].width, again.views[0].height) == (48, 48)
    assert np.isclose(again.views[0].fx, first.views[0].fx / 2)
    for one, two in zip(first.views, again.views, strict=True):
        assert np.allclose(one.world_to_camera, two.world_to_camera, atol=1e-12)


def test_other_programs_paths_are_in_the_world_of_the_exported_cameras(tmp_path):
    """The Gaussians' world has another origin than that of transforms.json."""
    file = tmp_path / "camera_path.json"
    file.write_text(json.dumps(NERFSTUDIO))
    video = VideoExport(path=str(file))
    origin = np.array([100.0, 200.0, 0.0])
    path = path_module.camera_path(ring(90), 3.0, UP, video, origin)
    assert np.allclose(centres(path.views), CENTRES - origin)
    assert np.allclose([view.fy / view.height for view in path.views], [1, 2]), "it zooms"
    assert describe_path(path).focal_factors == pytest.approx((1, 2))
