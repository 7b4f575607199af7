"""Views: sizes, scaled intrinsics, the split and the scene's extent."""

import numpy as np
import pytest

from pipeline.config.schema import Split, Views
from pipeline.geometry.cameras import Camera
from pipeline.geometry.up_direction import up_direction
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import Posed, Reconstruction
from pipeline.scene.views import load_views, scene_extent, view_size


def make(count: int, camera: Camera | None = None) -> tuple[Manifest, Reconstruction]:
    camera = camera or Camera("PINHOLE", 301, 200, np.array([250.0, 260.0, 150.0, 99.0]))
    names = [f"p{i:02d}.jpg" for i in range(count)]
    photos = [
        Photo(
            name=n, path=f"/x/{n}", width=301, height=200, digest=n, mask=f"/m/{n}", mask_digest="m"
        )
        for n in names
    ]
    images = {
        i + 1: Posed(n, 1, np.eye(3), np.array([-float(i), 0, 0])) for i, n in enumerate(names)
    }
    return Manifest(scene="s", photos=tuple(photos)), Reconstruction({1: camera}, images)


def test_sizes():
    assert view_size(301, 200, 960) == (301, 200)
    assert view_size(720, 1280, 960) == (540, 960)
    assert view_size(10_000, 1, 100) == (100, 1)


def test_intrinsics_scale_by_the_exact_ratio_of_each_side():
    manifest, model = make(1)
    (view,) = load_views(manifest, model, Views(max_long_side_px=100), Split())
    assert (view.width, view.height) == (100, 66)
    ratio_x, ratio_y = 100 / 301, 66 / 200
    expected = (250 * ratio_x, 260 * ratio_y, 150 * ratio_x, 99 * ratio_y)
    np.testing.assert_allclose((view.fx, view.fy, view.cx, view.cy), expected)


def test_every_eighth_of_the_posed_photographs_by_name_is_held_out():
    manifest, model = make(20)
    del model.images[1]  # p00 has no pose: p01 is the first of the split.
    views = load_views(manifest, model, Views(), Split())
    assert [view.name for view in views if view.is_test] == ["p01.jpg", "p09.jpg", "p17.jpg"]
    assert not any(
        view.is_test for view in load_views(manifest, model, Views(), Split(holdout_every=0))
    )


def test_masks_can_be_ignored():
    manifest, model = make(1)
    assert load_views(manifest, model, Views(), Split())[0].mask == "/m/p00.jpg"
    assert load_views(manifest, model, Views(masks="ignore"), Split())[0].mask is None


def test_distorting_cameras_are_refused():
    manifest, model = make(1, Camera("SIMPLE_RADIAL", 301, 200, np.array([250.0, 150, 100, 0.1])))
    with pytest.raises(ValueError, match="SIMPLE_RADIAL"):
        load_views(manifest, model, Views(), Split())


def test_extent():
    manifest, model = make(9)
    views = load_views(manifest, model, Views(), Split(holdout_every=8))
    # Training cameras stand at x = 1 ... 7: 3 from their mean.
    assert scene_extent(views) == pytest.approx(3.3)
    assert scene_extent(views[:1]) == 1.0


def test_rounding_is_no_extent():
    """Cameras in one place, whose poses say so to the last bit but one."""
    manifest, model = make(9)
    rng = np.random.default_rng(0)
    images = {}
    for number, image in model.images.items():
        turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        centre = np.array([0.3, -7.0, 2.0])
        images[number] = Posed(image.name, 1, turned, -turned @ centre)
    views = load_views(manifest, Reconstruction(model.cameras, images), Views(), Split())
    assert len({tuple(view.centre) for view in views}) > 1
    assert scene_extent(views) == 1.0


def test_up_is_what_the_cameras_agree_on():
    """Cameras around a y-down world that look down at it: tilts cancel, up stays."""
    rotations = []
    for angle in np.arange(0, 2 * np.pi, 0.5 * np.pi):
        forward = np.array([np.cos(angle), 0.6, np.sin(angle)]) / np.sqrt(1.36)
        right = np.cross([0, 1.0, 0], forward)
        right /= np.linalg.norm(right)
        rotations.append([right, np.cross(forward, right), forward])
    np.testing.assert_allclose(up_direction(np.array(rotations), [1] * 4), [0, -1, 0], atol=1e-9)


@pytest.mark.parametrize("orientation, quarter_turns", [(1, 0), (8, 1), (3, 2), (6, 3)])
def test_up_knows_cameras_that_were_turned(orientation, quarter_turns):
    """EXIF says how the picture is to be turned (anticlockwise by 90 degrees for 8) to stand: a
    camera turned clockwise sees the world's up to its right."""
    angle = quarter_turns * np.pi / 2
    c, s = np.cos(angle), np.sin(angle)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    found = up_direction(turned[None], [orientation])
    np.testing.assert_allclose(found, [0, -1, 0], atol=1e-9)


def test_up_is_level_where_all_cameras_look_up():
    """A facade from below: every camera is tilted the same way, and up is still up."""
    rotations = []
    for angle in np.radians([-30, -10, 10, 30]):
        forward = np.array([np.sin(angle), -0.5, np.cos(angle)]) / np.sqrt(1.25)
        right = np.cross([0, 1.0, 0], forward)
        right /= np.linalg.norm(right)
        rotations.append([right, np.cross(forward, right), forward])
    found = up_direction(np.array(rotations), [1] * 4)
    assert np.degrees(np.arccos(found @ [0, -1, 0])) < 4, found


def test_up_is_above_cameras_that_look_down():
    """A drone that flies to and fro: its pictures' tops point all ways along the ground."""
    down, rotations = np.array([0.0, 1.0, 0.0]), []
    for angle in np.radians([0, 0, 180, 180, 175, 5, 90]):
        right = np.array([np.cos(angle), 0.0, np.sin(angle)])
        rotations.append([right, np.cross(down, right), down])
    found = up_direction(np.array(rotations), [1] * 7)
    np.testing.assert_allclose(found, [0, -1, 0], atol=0.1)


def test_up_without_cameras_is_against_y():
    assert up_direction(np.zeros((0, 3, 3)), []).tolist() == [0, -1, 0]
