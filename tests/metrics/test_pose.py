"""Pose errors: alignment, angles, and areas under curves computed by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.similarity import umeyama
from pipeline.metrics.pose import auc_of_errors, pose_error
from pipeline.scene.reconstruction import PosedImage, Reconstruction


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else q * [1, 1, -1]


def turned(axis: int, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.eye(3)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def scene(seed: int, count: int = 8) -> Reconstruction:
    rng = np.random.default_rng(seed)
    images = {
        i: PosedImage(f"{i}.jpg", 1, random_rotation(rng), rng.normal(size=3)) for i in range(count)
    }
    return Reconstruction({}, images)


def moved(model: Reconstruction, scale: float, rotation, shift) -> Reconstruction:
    """The same scene in another frame: X' = scale * rotation @ X + shift."""
    images = {}
    for i, image in model.images.items():
        r = image.rotation @ rotation.T
        images[i] = PosedImage(image.name, 1, r, scale * image.translation - r @ shift)
    return Reconstruction({}, images)


@settings(max_examples=60, derandomize=True, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(3, 30),
    scale=st.floats(1e-4, 1e4),
    offset=st.floats(-1e3, 1e3),
)
def test_umeyama_recovers_a_known_similarity(seed, count, scale, offset):
    rng = np.random.default_rng(seed)
    source, rotation = rng.normal(size=(count, 3)), random_rotation(rng)
    shift = rng.normal(size=3) + offset
    target = scale * source @ rotation.T + shift
    found_scale, found_rotation, found_shift = umeyama(source, target)
    size = scale * np.abs(source).max() + np.abs(shift).max()
    fitted = found_scale * source @ found_rotation.T + found_shift
    np.testing.assert_allclose(fitted, target, atol=1e-9 * size)
    np.testing.assert_allclose(found_rotation @ found_rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(found_rotation) == pytest.approx(1)


@settings(max_examples=60, derandomize=True, deadline=None)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 12), dimensions=st.integers(0, 3))
def test_umeyama_always_returns_a_proper_rotation(seed, count, dimensions):
    rng = np.random.default_rng(seed)
    keep = np.arange(3) < dimensions
    source, target = rng.normal(size=(2, count, 3)) * keep
    scale, rotation, shift = umeyama(source, -target)
    assert scale >= 0 and np.isfinite(shift).all()
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_umeyama_returns_no_reflection():
    source = np.random.default_rng(0).normal(size=(20, 3))
    _, rotation, _ = umeyama(source, source * [-1, 1, 1])
    assert np.linalg.det(rotation) == pytest.approx(1)


@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_a_similarity_of_the_scene_has_no_error(count):
    truth = scene(1, count)
    rotation = random_rotation(np.random.default_rng(2))
    error = pose_error(moved(truth, 3.0, rotation, np.array([1.0, 2, 3])), truth)
    assert error.rotation_median_deg == pytest.approx(0, abs=1e-6)
    assert error.num_common == error.num_truth == count
    if count >= 3:
        assert error.centre_median == pytest.approx(0, abs=1e-9)
        assert error.scale == pytest.approx(1 / 3)
    else:
        assert error.centre_median is None
    if count >= 2:
        assert error.auc == pytest.approx({1.0: 1.0, 5.0: 1.0, 10.0: 1.0})


def test_collinear_cameras_are_aligned_by_their_rotations():
    rng = np.random.default_rng(3)
    images = {}
    for i in range(6):
        r = random_rotation(rng)
        images[i] = PosedImage(f"{i}.jpg", 1, r, -r @ np.array([i, 0.0, 0.0]))
    truth = Reconstruction({}, images)
    error = pose_error(moved(truth, 2.0, random_rotation(rng), np.ones(3)), truth)
    assert error.rotation_median_deg == pytest.approx(0, abs=1e-6)
    assert error.centre_median == pytest.approx(0, abs=1e-9)


def test_one_camera_turned_in_place_by_two_degrees():
    truth = scene(4, 4)
    images = dict(truth.images)
    first = images[0]
    rotation = turned(2, 2.0) @ first.rotation
    images[0] = PosedImage(first.name, 1, rotation, -rotation @ first.centre)
    error = pose_error(Reconstruction({}, images), truth)
    assert error.rotation_mean_deg == pytest.approx(2.0 / 4)
    assert error.rotation_median_deg == pytest.approx(0, abs=1e-9)
    assert error.centre_mean == pytest.approx(0, abs=1e-9)
    # Three of the six pairs turn by exactly 2 degrees, but the direction to the other camera
    # can turn by no more: they have error 2. Recall rises to 1/2 at 0, then to 1 over 2 degrees.
    assert error.auc is not None
    assert error.auc[1.0] == pytest.approx(0.5)
    assert error.auc[10.0] == pytest.approx(auc_of_errors(np.array([0, 0, 0, 2, 2, 2.0]), 10.0))


def test_pairs_with_missing_images_are_failures():
    truth = scene(5, 5)
    found = Reconstruction({}, {i: truth.images[i] for i in (0, 1, 2)})
    error = pose_error(found, truth)
    # 3 of the 10 pairs are known.
    assert error.auc == pytest.approx({1.0: 0.3, 5.0: 0.3, 10.0: 0.3})
    assert (error.num_common, error.num_truth) == (3, 5)


def test_developed_raw_files_are_matched_by_their_stems():
    truth = scene(5, 5)
    renamed = {
        i: replace(image, name=image.name.rsplit(".", 1)[0] + ".png")
        for i, image in truth.images.items()
    }
    error = pose_error(Reconstruction({}, renamed), truth)
    assert error.num_common == 5
    assert error.rotation_median_deg == pytest.approx(0, abs=1e-5)


def test_no_common_image_is_accepted():
    error = pose_error(Reconstruction({}, {}), scene(6, 3))
    assert error.rotation_median_deg is None and error.centre_median is None
    assert error.auc == {1.0: 0.0, 5.0: 0.0, 10.0: 0.0}


@pytest.mark.parametrize(
    ("errors", "limit", "area"),
    [
        ([0.0, 0.0], 1.0, 1.0),
        ([np.inf, np.inf], 1.0, 0.0),
        # One error of 1 below 2: recall rises linearly to 1 at 1, then stays: (1/2 + 1) / 2.
        ([1.0], 2.0, 0.75),
        # Recall 1/2 at 1, still 1/2 at the limit of 2 (the next is beyond): (1/4 + 1/2) / 2.
        ([1.0, 3.0], 2.0, 0.375),
        ([], 1.0, 0.0),
    ],
)
def test_area_under_recall_by_hand(errors, limit, area):
    assert auc_of_errors(np.array(errors), limit) == pytest.approx(area)
