"""Views: sizes, scaled intrinsics, test views, the scene's extent and up direction."""

import numpy as np
import pytest

from pipeline.config.schema import Split, Views
from pipeline.geometry.cameras import Camera
from pipeline.geometry.up_direction import up_direction
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import PosedImage, Reconstruction
from pipeline.scene.views import load_views, scene_extent, view_size


def make(count: int, camera: Camera | None = None) -> tuple[Manifest, Reconstruction]:
    camera = camera or Camera("PINHOLE", 301, 200, np.array([250.0, 260.0, 150.0, 99.0]))
    names = [f"p{i:02d}.jpg" for i in range(count)]
    files = [{"path": f"/x/{n}", "digest": n, "mask": f"/m/{n}", "mask_digest": "m"} for n in names]
    photos = [
        Photo(name=n, width=301, height=200, **file) for n, file in zip(names, files, strict=True)
    ]
    images = {
        i + 1: PosedImage(n, 1, np.eye(3), np.array([-float(i), 0, 0])) for i, n in enumerate(names)
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


def test_every_eighth_photograph_with_a_pose_is_a_test_view():
    manifest, model = make(20)
    del model.images[1]  # Without p00's pose, p01 is the first test view.
    views = load_views(manifest, model, Views(), Split())
    assert [view.name for view in views if view.is_test] == ["p01.jpg", "p09.jpg", "p17.jpg"]
    assert not any(
        view.is_test for view in load_views(manifest, model, Views(), Split(test_every=0))
    )


def test_views_of_one_photograph_are_all_for_testing_or_all_for_training():
    manifest, model = make(20)
    photos = [
        p.model_copy(update={"source": f"s{i // 3}.jpg"}) for i, p in enumerate(manifest.photos)
    ]
    views = load_views(
        Manifest(scene="s", photos=tuple(photos)), model, Views(), Split(test_every=4)
    )
    assert [v.source for v in views if v.is_test] == ["s0.jpg"] * 3 + ["s4.jpg"] * 3
    one = Manifest(scene="s", photos=tuple(photos[:3]))
    assert not any(v.is_test for v in load_views(one, model, Views(), Split()))


def test_masks_can_be_ignored():
    manifest, model = make(1)
    assert load_views(manifest, model, Views(), Split())[0].mask == "/m/p00.jpg"
    assert load_views(manifest, model, Views(masks="ignore"), Split())[0].mask is None


def test_cameras_with_lens_distortion_are_an_error():
    manifest, model = make(1, Camera("SIMPLE_RADIAL", 301, 200, np.array([250.0, 150, 100, 0.1])))
    with pytest.raises(ValueError, match="SIMPLE_RADIAL"):
        load_views(manifest, model, Views(), Split())


def test_extent():
    manifest, model = make(9)
    views = load_views(manifest, model, Views(), Split(test_every=8))
    # Training cameras are at x = 1 ... 7, at most 3 from their mean.
    assert scene_extent(views) == pytest.approx(3.3)
    assert scene_extent(views[:1]) == 1.0


def test_extent_of_cameras_in_one_place_is_one():
    """The camera centres differ by rounding errors only."""
    manifest, model = make(9)
    rng = np.random.default_rng(0)
    images = {}
    for number, image in model.images.items():
        turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        centre = np.array([0.3, -7.0, 2.0])
        images[number] = PosedImage(image.name, 1, turned, -turned @ centre)
    views = load_views(manifest, Reconstruction(model.cameras, images), Views(), Split())
    assert len({tuple(view.centre) for view in views}) > 1
    assert scene_extent(views) == 1.0


def looking_along(*directions: list[float]) -> np.ndarray:
    """(N, 3, 3) rotations of cameras that are not rolled, in a y-down world."""
    rotations = []
    for direction in directions:
        forward = np.array(direction) / np.linalg.norm(direction)
        right = np.cross([0, 1.0, 0], forward)
        right /= np.linalg.norm(right)
        rotations.append([right, np.cross(forward, right), forward])
    return np.array(rotations)


def test_up_of_cameras_around_a_scene():
    """Cameras on a circle that look down at the middle of a y-down world: their tilts cancel."""
    rotations = looking_along([1, 0.6, 0], [0, 0.6, 1], [-1, 0.6, 0], [0, 0.6, -1])
    np.testing.assert_allclose(up_direction(rotations, [1] * 4), [0, -1, 0], atol=1e-9)


@pytest.mark.parametrize("orientation, quarter_turns", [(1, 0), (8, 1), (3, 2), (6, 3)])
def test_up_follows_the_exif_orientation(orientation, quarter_turns):
    """The orientation is the rotation that makes the image upright, anticlockwise by 90 degrees
    for 8: up is to the right in the stored image of a camera that was turned clockwise."""
    angle = quarter_turns * np.pi / 2
    c, s = np.cos(angle), np.sin(angle)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    found = up_direction(turned[None], [orientation])
    np.testing.assert_allclose(found, [0, -1, 0], atol=1e-9)


def test_up_of_cameras_with_the_same_tilt():
    """A facade photographed from below: the mean of the columns alone would be tilted too."""
    angles = np.radians([-30, -10, 10, 30])
    rotations = looking_along(*([np.sin(angle), -0.5, np.cos(angle)] for angle in angles))
    found = up_direction(rotations, [1] * 4)
    assert np.degrees(np.arccos(found @ [0, -1, 0])) < 4, found


def test_up_of_cameras_that_look_straight_down():
    """A drone's nadir images in several headings: their columns lie in the ground plane."""
    down, rotations = np.array([0.0, 1.0, 0.0]), []
    for angle in np.radians([0, 0, 180, 180, 175, 5, 90]):
        right = np.array([np.cos(angle), 0.0, np.sin(angle)])
        rotations.append([right, np.cross(down, right), down])
    found = up_direction(np.array(rotations), [1] * 7)
    np.testing.assert_allclose(found, [0, -1, 0], atol=0.1)


def test_up_without_cameras_is_minus_y():
    assert up_direction(np.zeros((0, 3, 3)), []).tolist() == [0, -1, 0]
