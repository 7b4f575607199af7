"""The tree of chunks: every Gaussian in one leaf, blocks first, boxes around the Gaussians."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.splats.chunks import Chunk, box, chunks_of, levels_of
from tests.splats.samples import sample


def leaves(chunk: Chunk) -> list[Chunk]:
    return [leaf for child in chunk.children for leaf in leaves(child)] or [chunk]


@pytest.mark.parametrize("count", [1, 10, 11, 97])
def test_every_gaussian_is_in_one_leaf_of_at_most_so_many(count) -> None:
    means = np.random.default_rng(count).normal(size=(120, 3)).astype(np.float32)
    rows = np.random.default_rng(0).permutation(120)[:count]
    found = [leaf.rows for leaf in leaves(chunks_of(means, rows, 10))]
    assert sorted(np.concatenate(found)) == sorted(rows)
    assert all(1 <= len(part) <= 10 for part in found)


def test_identical_means_are_divided() -> None:
    found = leaves(chunks_of(np.zeros((40, 3), np.float32), np.arange(40), 10))
    assert [len(leaf.rows) for leaf in found] == [10] * 4


def test_the_first_branches_are_the_blocks() -> None:
    """A block without Gaussians has no branch."""
    means = np.random.default_rng(1).normal(size=(60, 3)).astype(np.float32)
    blocks = np.repeat([4, 1, 7], 20)
    rows = np.arange(60)[::-1]
    tree = chunks_of(means, rows, 8, blocks)
    assert [set(child.rows) for child in tree.children] == [
        set(rows[blocks == number]) for number in (1, 4, 7)
    ]


def test_one_block_adds_no_branch() -> None:
    means = np.zeros((5, 3), np.float32)
    assert not chunks_of(means, np.arange(5), 8, np.ones(5, np.intp)).children


def test_levels_end_at_one_gaussian() -> None:
    assert [len(level) for level in levels_of(sample(5, 1).as_arrays(), 6)] == [5, 3, 2, 1, 1, 1]


def test_a_box_contains_points_drawn_from_the_gaussians() -> None:
    """Along a world axis, a rotated Gaussian reaches as far as the root of its variance there."""
    gaussians = sample(1, 0).as_arrays()
    gaussians.log_scales[:] = np.log([1.0, 2.0, 3.0])
    half = np.sqrt(0.5)
    gaussians.quats[:] = (half, 0, 0, half)  # A quarter turn about z exchanges x and y.
    low, high = box(gaussians, 3.0)
    np.testing.assert_allclose((high - low) / 2, [6, 3, 9], rtol=1e-6)
    np.testing.assert_allclose((high + low) / 2, gaussians.means[0], rtol=1e-5, atol=1e-6)
    gaussians.quats[:] = (np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8))
    low, high = box(gaussians, 1.0)
    np.testing.assert_allclose((high - low)[:2] / 2, [np.sqrt(2.5)] * 2, rtol=1e-6)
