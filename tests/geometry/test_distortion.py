"""Projection and unprojection of every camera model agree with pycolmap's."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.cameras import CAMERA_MODELS, Camera
from pipeline.geometry.distortion import distort, fold_radius, project, undistort, unproject
from pipeline.runtime.isolate import run_isolated

PARAMS = {
    "SIMPLE_PINHOLE": [400, 320, 240],
    "PINHOLE": [400, 410, 318, 243],
    "SIMPLE_RADIAL": [400, 320, 240, -0.12],
    "RADIAL": [400, 320, 240, -0.15, 0.04],
    "OPENCV": [400, 410, 318, 243, -0.2, 0.06, 0.002, -0.003],
    "OPENCV_FISHEYE": [300, 305, 318, 243, 0.02, -0.01, 0.003, -0.0005],
    "FULL_OPENCV": [400, 410, 318, 243, 0.3, 0.02, 0.001, -0.002, 0.01, 0.5, 0.05, 0.002],
    "SIMPLE_RADIAL_FISHEYE": [300, 320, 240, 0.03],
    "RADIAL_FISHEYE": [300, 320, 240, 0.03, -0.01],
    "FOV": [400, 410, 318, 243, 0.9],
    "THIN_PRISM_FISHEYE": [300, 305, 318, 243, 0.02, -0.01, 1e-3, -2e-3, 3e-3, -5e-4, 4e-3, -3e-3],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        *(300, 305, 318, 243, 0.02, -0.01, 3e-3, -5e-4, 1e-4, 2e-5),
        *(1e-3, -2e-3, 4e-3, 1e-3, -3e-3, 2e-3),
    ],
    "SIMPLE_DIVISION": [400, 320, 240, -0.2],
    "DIVISION": [400, 410, 318, 243, 0.15],
    "SIMPLE_FISHEYE": [300, 320, 240],
    "FISHEYE": [300, 305, 318, 243],
    "EUCM": [300, 305, 318, 243, 0.6, 1.1],
}


def camera(model: str) -> Camera:
    return Camera(model, 640, 480, np.array(PARAMS[model], dtype=np.float64))


def grid() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-0.75, 0.75, 13), np.linspace(-0.55, 0.55, 9))
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def by_pycolmap(points: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Model -> pixels of normalised coordinates, and what these are unprojected to."""
    import pycolmap

    found = {}
    for model, params in PARAMS.items():
        c = pycolmap.Camera(model=model, width=640, height=480, params=params)
        xy = np.asarray(c.img_from_cam(np.column_stack([points, np.ones(len(points))])))
        found[model] = xy, np.asarray(c.cam_from_img(xy))
    return found


def test_all_models_project_and_unproject_as_pycolmap_does() -> None:
    points = grid()
    expected = run_isolated(by_pycolmap, points)
    assert set(expected) == set(CAMERA_MODELS) - {"EQUIRECTANGULAR"}  # see test_rays.py
    for model, (xy, back) in expected.items():
        np.testing.assert_allclose(project(camera(model), points), xy, atol=1e-8, err_msg=model)
        ours = unproject(camera(model), xy)
        np.testing.assert_allclose(ours, back[:, :2], atol=1e-6, err_msg=model)
        np.testing.assert_allclose(ours, points, atol=1e-8, err_msg=model)


@pytest.mark.parametrize("model", sorted(PARAMS))
def test_a_camera_resized_with_its_image_sees_the_same(model: str) -> None:
    whole, rays = camera(model), grid() / 2
    for width, height in ((320, 240), (321, 240)):
        factor = np.array([width / 640, height / 480])
        resized = whole.resized(width, height)
        np.testing.assert_allclose(project(resized, rays), project(whole, rays) * factor)


def test_a_division_model_ends_at_its_fold() -> None:
    lens = camera("DIVISION")
    radius = fold_radius(lens)
    inside, outside = np.array([[radius * 0.99, 0.0]]), np.array([[radius * 1.01, 0.0]])
    np.testing.assert_allclose(undistort(lens, distort(lens, inside)), inside, atol=1e-8)
    assert np.isnan(distort(lens, outside)).all()
    assert np.isnan(undistort(lens, np.array([[2.7, 0.0]]))).all()


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV_FISHEYE"])
def test_points_beyond_the_fold_radius_have_no_inverse(model: str) -> None:
    start = [400.0, 320, 240] if model == "SIMPLE_RADIAL" else [300.0, 300, 320, 240]
    rest = [-0.3] if model == "SIMPLE_RADIAL" else [-0.3, 0, 0, 0]
    params = [*start, *rest]
    strong = Camera(model, 640, 480, np.array(params))
    radius = fold_radius(strong)
    edge = distort(strong, np.array([[radius, 0.0]]))[0, 0]
    inside = undistort(strong, np.array([[edge * 0.98, 0.0]]))
    assert 0 < inside[0, 0] < radius
    assert np.isnan(undistort(strong, np.array([[edge * 1.02, 0.0]]))).all()


def test_fisheye_rays_at_ninety_degrees_have_no_normalised_coordinates() -> None:
    lens = Camera("OPENCV_FISHEYE", 640, 480, np.array([200.0, 200, 320, 240, 0, 0, 0, 0]))
    points = unproject(lens, np.array([[320 + 200 * 1.5, 240.0], [320 + 200 * 1.58, 240.0]]))
    np.testing.assert_allclose(points[0], [np.tan(1.5), 0], rtol=1e-9)
    assert np.isnan(points[1]).all()
