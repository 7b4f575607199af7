"""Subsampling: bounded, even, and the same however a file is divided into chunks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.io.clouds.sampling import VoxelSampler, thinned
from pipeline.io.clouds.values import Chunk


def sampled(xyz: np.ndarray, limit: int, sizes: list[int]) -> np.ndarray:
    sampler = VoxelSampler(limit)
    for part in np.split(xyz, np.cumsum(sizes)[:-1] if sizes else []):
        sampler.add(Chunk(part))
    cloud = sampler.result()
    assert cloud.num_read == len(xyz)
    return cloud.xyz


@given(st.integers(0, 99), st.integers(100, 2000), st.floats(-1e7, 1e7), st.integers(-9, 9))
def test_the_limit_holds_and_the_order_is_the_files(seed, limit, away, exponent):
    rng = np.random.default_rng(seed)
    xyz = away + 10.0**exponent * rng.normal(size=(3000, 3))
    found = sampled(xyz, limit, [3000])
    assert 0 < len(found) <= limit
    rows = {tuple(row): i for i, row in enumerate(xyz[::-1].tolist())}
    order = [-rows[tuple(row)] for row in found.tolist()]
    assert order == sorted(order)


@given(st.integers(0, 99), st.integers(1, 9))
def test_chunks_do_not_change_the_result(seed, parts):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(0, 10, (4000, 3)) * (1, 1, 0)
    xyz[0], xyz[1] = 0, 10  # The first chunk determines the finest grid only.
    sizes = [4000 // parts] * (parts - 1)
    whole = sampled(xyz, 500, [4000])
    np.testing.assert_array_equal(sampled(xyz, 500, [*sizes, 4000 - sum(sizes)]), whole)


def test_dense_parts_are_thinned_and_sparse_ones_kept():
    rng = np.random.default_rng(0)
    sparse = rng.uniform(0, 100, (300, 3))
    dense = rng.uniform(0, 1, (100_000, 3))
    xyz = np.concatenate([dense, sparse])
    for kept in (sampled(xyz, 1000, [100_300]), xyz[thinned(xyz, 1000)]):
        assert len(kept) <= 1000
        assert (kept > 1).any(1).sum() > 280


def test_thinning_comes_near_the_limit():
    xyz = np.random.default_rng(0).uniform(0, 1, (50_000, 3))
    for limit in (10, 1000, 20_000, 50_000):
        assert 0.8 * limit < len(thinned(xyz, limit)) <= limit


def test_voxels_may_differ_in_size():
    """On a surface, the number of voxels goes with the inverse square of their side."""
    xyz = np.random.default_rng(0).uniform(0, 1, (100_000, 3)) * (1, 1, 0)
    right = xyz[:, 0] > 0.5
    kept = thinned(xyz, 2000, np.where(right, 1.0, 4.0))
    assert len(kept) <= 2000
    share = right[kept].mean()
    assert 0.9 < share < 0.97
    extreme = np.exp(np.random.default_rng(0).normal(0, 100, len(xyz)))
    assert 0 < len(thinned(xyz, 2000, extreme)) <= 2000


def test_points_in_one_place_are_one():
    assert len(sampled(np.full((100, 3), 7.5), 10, [100])) == 1
    assert len(thinned(np.full((100, 3), 7.5), 10)) >= 1


@pytest.mark.parametrize("outlier", [1e17, -1e17, 1e30, np.inf, np.nan])
def test_an_outlier_costs_no_more_than_itself(outlier):
    xyz = np.random.default_rng(0).uniform(0, 1, (2000, 3))
    xyz[77, 1] = outlier
    assert len(sampled(xyz, 5000, [2000])) >= (1 if abs(outlier) == 1e17 else 1999)
