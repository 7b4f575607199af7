"""Levels of detail by merging pairs of Gaussians."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.splats.arrays import GaussianArrays
from pipeline.splats.levels import halved, merged_to
from tests.splats.samples import sample


def pair(apart: float, count: int = 1) -> GaussianArrays:
    """Pairs of equal round Gaussians, ``apart`` standard deviations from each other along x."""
    means = np.zeros((2 * count, 3), np.float32)
    means[1::2, 0] = apart * 0.1
    means[:, 1] = np.repeat(np.arange(count) * 100.0, 2)
    sh = np.zeros((2 * count, 1, 3), np.float32)
    sh[1::2] = 1
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (2 * count, 1))
    scales = np.full((2 * count, 3), np.log(0.1), np.float32)
    return GaussianArrays(means, scales, quats, np.zeros(2 * count, np.float32), sh)


@pytest.mark.parametrize("count", [1, 2, 7, 300])
@pytest.mark.parametrize("degree", [0, 3])
def test_half_of_the_gaussians_are_left_and_finite(count, degree) -> None:
    found = halved(sample(count, degree).as_arrays())
    assert len(found) == (count + 1) // 2 and found.sh_degree == degree
    for values in found.arrays().values():
        assert values.dtype == np.float32 and np.isfinite(values).all()
    assert np.linalg.norm(found.quats, axis=1).min() > 0


def test_a_pair_keeps_its_mean_covariance_and_mean_colour() -> None:
    found = halved(pair(apart=2.0))
    np.testing.assert_allclose(found.means, [[0.1, 0, 0]], atol=1e-6)
    # The variance along x is that of each, and of their means: 0.1^2 + 0.1^2.
    np.testing.assert_allclose(
        np.sort(np.exp(found.log_scales[0])), [0.1, 0.1, 0.1 * 2**0.5], rtol=1e-4
    )
    np.testing.assert_allclose(found.sh[0, 0], 0.5, atol=1e-6)


def test_two_in_one_place_cover_what_both_cover() -> None:
    found = halved(pair(apart=0.0))
    opacity = 1 / (1 + np.exp(-found.opacity_logits))
    assert opacity == pytest.approx(0.9999, abs=1e-4), "half and half, on the same area"


def test_near_and_similar_gaussians_are_merged_first() -> None:
    near, far = pair(0.1), pair(8.0)
    far.means[:, 1] += 5
    together = GaussianArrays(
        **{n: np.concatenate([v, far.arrays()[n]]) for n, v in near.arrays().items()}
    )
    together.means[3, 1] = 5.2
    found = halved(together)
    assert len(found) == 2
    assert np.isclose(found.means[:, 0], 0.005, atol=1e-3).any()


def test_the_rotation_of_a_pair_follows_the_line_between_them() -> None:
    both = pair(apart=6.0)
    both.means[1] = (0.3, 0.3, 0)
    found = halved(both)
    axes = quat_to_rotation(found.quats[0].astype(np.float64))
    long = axes[:, found.log_scales[0].argmax()]
    np.testing.assert_allclose(np.abs(long), [0.5**0.5, 0.5**0.5, 0], atol=1e-4)


def test_gaussians_in_one_place_are_merged_without_end() -> None:
    gaussians = sample(64, 0).as_arrays()
    gaussians.means[:] = 1
    assert len(halved(gaussians)) == 32


def test_the_same_gaussians_give_the_same_bits() -> None:
    first, second = (halved(sample(400).as_arrays()).arrays() for _ in range(2))
    for name, values in first.items():
        np.testing.assert_array_equal(values, second[name])


@pytest.mark.parametrize("count", [1, 7, 100, 299, 300, 400])
def test_merging_to_a_number_leaves_that_number(count) -> None:
    gaussians = sample(300).as_arrays()
    found = merged_to(gaussians, count, np.ones(300))
    assert len(found) == min(count, 300)
    assert all(np.isfinite(values).all() for values in found.arrays().values())


def test_what_weighs_more_stays_and_leads_in_a_merge() -> None:
    near, far = pair(1.0), pair(1.0)
    far.means[:, 1] += 50
    both = {n: np.concatenate([v, far.arrays()[n]]) for n, v in near.arrays().items()}
    weights = np.array([1e-3, 3e-3, 1.0, 1.0])
    found = merged_to(GaussianArrays(**both), 3, weights)
    assert sorted(found.means[:, 1]) == [0, 50, 50], "the pair of small weights is merged"
    made = found.means[found.means[:, 1] == 0][0]
    assert made[0] == pytest.approx(0.075, abs=1e-6)
