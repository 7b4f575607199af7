"""Scenes in any unit and anywhere: poses go to the scene's world and come back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import quat_to_rotation
from pipeline.scene.georeference import CartesianOrigin, Georeference
from pipeline.scene.normalization import IDENTITY, Normalization
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from pipeline.scene.views import View


def model_at(middle: np.ndarray, size: float, seed: int) -> Reconstruction:
    """Cameras and points within ``size`` of ``middle``."""
    rng = np.random.default_rng(seed)
    images = {}
    for i in range(1, 6):
        rotation = quat_to_rotation(rng.normal(size=4))
        centre = middle + size * rng.normal(size=3)
        images[i] = PosedImage(f"{i}.png", 1, rotation, -rotation @ centre)
    xyz = middle + size * rng.normal(size=(4, 3))
    points = Points.without_tracks(xyz, np.zeros((4, 3), np.uint8))
    return Reconstruction({1: Camera("PINHOLE", 8, 6, np.array([8.0, 8, 4, 3]))}, images, points)


@given(st.integers(-9, 9), st.floats(-1e7, 1e7), st.integers(0, 9))
def test_a_model_comes_back_with_the_precision_of_the_input(exponent, away, seed):
    size = 10.0**exponent
    origin = away * size * np.array([1.0, -0.3, 0.7])
    model = model_at(origin, size, seed)
    there = Normalization(1 / size, origin)
    scene = there.model_to_scene(model)
    assert np.abs(scene.points.xyz).max() < 10
    back = there.model_to_given(scene)
    length = size * (abs(away) + 1)
    for i, image in model.images.items():
        assert (back.images[i].rotation == image.rotation).all()
        off = np.abs(back.images[i].translation - image.translation).max()
        assert off <= 1e-14 * length
        # The same pixels: both worlds have the same directions in the camera.
        local = image.rotation @ model.points.xyz[0] + image.translation
        found = scene.images[i].rotation @ scene.points.xyz[0] + scene.images[i].translation
        np.testing.assert_allclose(found * size, local, atol=1e-14 * length)
    np.testing.assert_allclose(back.points.xyz, model.points.xyz, atol=1e-15 * length)


def test_a_view_comes_back_as_its_image_does():
    there = Normalization(1e-3, np.array([5e6, 4e5, 300.0]))
    model = model_at(there.origin, 1e3, 0)
    scene = there.model_to_scene(model)
    image = scene.images[2]
    view = View("", "", None, 8, 6, 8.0, 8.0, 4.0, 3.0, image.world_to_camera, False)
    np.testing.assert_allclose(
        there.view_to_given(view).world_to_camera, model.images[2].world_to_camera, rtol=1e-9
    )


def test_the_identity_keeps_all_bits():
    model = model_at(np.zeros(3), 1.0, 0)
    assert IDENTITY.model_to_scene(model) is model
    assert IDENTITY.model_to_given(model) is model


@pytest.mark.parametrize("method, found", [("given", 0.001), ("gcp", 1.0)])
def test_only_given_poses_are_normalised(tmp_path, method, found):
    Georeference(
        method=method,
        axes="",
        unit="",
        origin=CartesianOrigin(x=1.0, y=2.0, z=3.0),
        projection=None,
        scale=0.001,
        rotation=np.eye(3).tolist(),
        translation=(0, 0, 0),
        residuals_m=None,
        residuals=(),
    ).write(tmp_path)
    assert Georeference.normalization_of(tmp_path).scale == found
    assert Georeference.normalization_of(tmp_path / "none").is_identity
