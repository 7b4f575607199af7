"""Rays through pixels and pixels of rays are inverse and agree with pycolmap's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.cameras import CAMERA_MODELS, Camera
from pipeline.geometry.rays import max_angle, pixels, rays
from pipeline.runtime.isolate import run_isolated
from tests.geometry.test_distortion import PARAMS

ALL_PARAMS = PARAMS | {"EQUIRECTANGULAR": [640, 480]}


def camera(model: str) -> Camera:
    return Camera(model, 640, 480, np.array(ALL_PARAMS[model], np.float64))


def image_grid() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(40, 600, 15), np.linspace(40, 440, 11))
    return np.stack([x, y], axis=-1)


def fisheye(degrees: float, k1: float = 0.0, k2: float = 0.0, size: int = 800) -> Camera:
    """A lens whose circle of ``degrees`` fills the image."""
    half = np.radians(degrees / 2)
    focal = size / 2 / (half + k1 * half**3 + k2 * half**5)
    params = np.array([focal, focal, size / 2, size / 2, k1, k2, 0.0, 0.0])
    return Camera("OPENCV_FISHEYE", size, size, params)


@pytest.mark.parametrize("model", list(ALL_PARAMS))
def test_pixels_are_the_inverse_of_rays(model: str) -> None:
    directions = rays(camera(model), image_grid())
    assert directions.shape == (11, 15, 3) and directions.dtype == np.float64
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(pixels(camera(model), 3 * directions), image_grid(), atol=1e-6)


def test_every_model_has_a_test_case() -> None:
    assert set(ALL_PARAMS) == set(CAMERA_MODELS)


def rays_by_pycolmap(xy: np.ndarray) -> dict[str, np.ndarray]:
    import pycolmap

    return {
        model: np.asarray(
            pycolmap.Camera(model=model, width=640, height=480, params=params).cam_ray_from_img(xy)
        )
        for model, params in ALL_PARAMS.items()
    }


def test_rays_agree_with_pycolmaps_cam_ray_from_img() -> None:
    xy = image_grid().reshape(-1, 2)
    for model, expected in run_isolated(rays_by_pycolmap, xy).items():
        # COLMAP's rays of fisheye lenses end at 90 degrees.
        own = rays(camera(model), xy)
        front = own[:, 2] > 0.01 if model != "EQUIRECTANGULAR" else np.ones(len(own), bool)
        assert front.mean() > 0.8
        np.testing.assert_allclose(own[front], expected[front], atol=1e-6)


def test_the_edges_of_a_panorama_are_behind_the_camera_and_its_rows_at_the_poles() -> None:
    found = rays(camera("EQUIRECTANGULAR"), np.array([[320.0, 240], [0, 240], [480, 240], [9, 0]]))
    expected = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0]]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert np.isnan(rays(camera("EQUIRECTANGULAR"), np.array([3.0, 481]))).all()


@pytest.mark.parametrize("degrees", [170.0, 190.0, 240.0, 300.0])
@pytest.mark.parametrize("k1, k2", [(0.0, 0.0), (0.02, -0.0005), (-0.015, 0.0)])
def test_fisheye_rays_at_and_beyond_90_degrees_have_pixels(
    degrees: float, k1: float, k2: float
) -> None:
    lens = fisheye(degrees, k1, k2)
    half = min(np.radians(degrees / 2), 0.999 * max_angle(lens))
    theta, azimuth = np.meshgrid(np.linspace(0, half, 50), np.linspace(0, 6.2, 17))
    directions = np.stack(
        [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)], axis=-1
    )
    xy = pixels(lens, directions)
    assert np.isfinite(xy).all()
    np.testing.assert_allclose(rays(lens, xy), directions, atol=1e-8)


def test_the_border_of_a_190_degree_lens_looks_backwards() -> None:
    lens = fisheye(190)
    border = rays(lens, np.array([800.0, 400]))
    np.testing.assert_allclose(
        border, [np.sin(np.radians(95)), 0, np.cos(np.radians(95))], atol=1e-9
    )
    assert np.isnan(pixels(camera("PINHOLE"), np.array([0.0, 0, -1]))).all()


def test_rays_beyond_the_fold_of_the_distortion_are_nan() -> None:
    lens = fisheye(200, k1=-0.1)
    limit = max_angle(lens)
    assert np.pi / 3 < limit < np.pi / 1.5
    beyond = limit + 0.01
    assert np.isnan(pixels(lens, np.array([np.sin(beyond), 0, np.cos(beyond)]))).all()
    assert np.isnan(rays(lens, np.array([5000.0, 400]))).all()


@given(st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_rays_are_unit_or_nan_for_any_coefficients(
    k1: float, k2: float, x: float, y: float
) -> None:
    lens = Camera("OPENCV_FISHEYE", 80, 60, np.array([30.0, 31.0, 40, 30, k1, k2, 0, 0]))
    ray = rays(lens, np.array([x, y]))
    assert np.isnan(ray).all() or abs(np.linalg.norm(ray) - 1) < 1e-9
