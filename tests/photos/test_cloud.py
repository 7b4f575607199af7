"""Points of a cloud: those that views see, in the scene's world, with colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.config.schema import Init
from pipeline.io.clouds.values import PointCloud
from pipeline.photos.cloud import placed_points, points_of_cloud
from pipeline.runtime.errors import UserError
from pipeline.scene.georeference import CartesianOrigin, GeographicOrigin, Georeference
from pipeline.scene.views import View

ORIGIN = np.array([544256.0, 5320919.0, 430.0])
RNG = np.random.default_rng(0)
# A wall at z = 4 in front of the camera, and another behind it.
WALL = np.column_stack([RNG.uniform(-1, 1, (400, 2)), np.full(400, 4.0)])
BEHIND = np.column_stack([RNG.uniform(-1, 1, (400, 2)), np.full(400, -4.0)])


@pytest.fixture
def view(tmp_path: Path) -> View:
    """A camera at the origin; the left half of its photograph is red, the right half blue."""
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[:, :32, 0] = pixels[:, 32:, 2] = 255
    path = tmp_path / "a.png"
    Image.fromarray(pixels).save(path)
    return View("a.png", str(path), None, 64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4), False)


def cloud_of(xyz: np.ndarray, rgb: np.ndarray | None = None) -> PointCloud:
    coloured = np.full(len(xyz), rgb is not None)
    colours = np.zeros((len(xyz), 3), np.uint8) if rgb is None else rgb
    return PointCloud(xyz, colours, coloured, len(xyz), 0)


def frame(method, origin) -> Georeference:
    return Georeference(
        method=method,
        axes="",
        unit="metres",
        origin=origin,
        projection=None,
        scale=1.0,
        rotation=np.eye(3).tolist(),
        translation=(0, 0, 0),
        residuals_m=None,
        residuals=(),
    )


UTM = frame("gcp", CartesianOrigin(x=ORIGIN[0], y=ORIGIN[1], z=ORIGIN[2]))
GPS = frame("gps", GeographicOrigin(latitude=48.0, longitude=9.0, altitude=430.0))


def test_only_points_in_a_view_are_used(view):
    xyz = np.concatenate([BEHIND, WALL])
    points = points_of_cloud(cloud_of(xyz), xyz, [view], 10_000)
    np.testing.assert_array_equal(points.xyz, WALL)
    assert len(points_of_cloud(cloud_of(xyz), xyz, [view], 50)) <= 50


def test_points_without_colour_get_it_from_the_photograph(view):
    points = points_of_cloud(cloud_of(WALL), WALL, [view], 10_000)
    left = points.xyz[:, 0] < 0
    assert (points.rgb[left] == (255, 0, 0)).all() and (points.rgb[~left] == (0, 0, 255)).all()


def test_hidden_points_get_no_colour_of_what_hides_them(view):
    hidden = WALL * (1, 1, 2)
    xyz = np.concatenate([WALL, hidden])
    points = points_of_cloud(cloud_of(xyz), xyz, [view], 10_000)
    grey = (points.rgb == 128).all(1)
    assert grey[points.xyz[:, 2] == 8].mean() > 0.8 and not grey[points.xyz[:, 2] == 4].any()


def test_colours_of_the_cloud_are_kept(view):
    rgb = RNG.integers(0, 256, WALL.shape).astype(np.uint8)
    assert (points_of_cloud(cloud_of(WALL, rgb), WALL, [view], 10_000).rgb == rgb).all()


def test_estimated_poses_place_a_cloud_by_ground_control_alone(view):
    cloud = cloud_of(WALL + ORIGIN)
    points = placed_points(cloud, UTM, [view], Init())
    assert points is not None
    np.testing.assert_allclose(points.xyz, WALL, atol=1e-9)
    assert placed_points(cloud, GPS, [view], Init()) is None
    assert placed_points(cloud_of(WALL), None, [view], Init()) is not None


@pytest.mark.parametrize("wrong", [WALL + ORIGIN, WALL * (1000, 1000, 1), BEHIND])
def test_a_cloud_in_another_frame_is_one_error(view, wrong):
    with pytest.raises(UserError, match="of its points in the views"):
        placed_points(cloud_of(wrong), None, [view], Init(points_file="scan.las"))
