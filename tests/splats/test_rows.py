"""Rows are copied and sorted as in one piece, at any number of threads."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.splats.rows import RANGE_ROWS, for_ranges, take_rows
from pipeline.splats.z_order import z_order

COUNT = 3 * RANGE_ROWS + 5


@pytest.mark.parametrize("threads", [1, 2, 16, 64])
def test_taken_rows_are_those_of_an_index(threads: int) -> None:
    draws = torch.Generator().manual_seed(0)
    tensors = {
        "vectors": torch.rand(1000, 4, 3, generator=draws),
        "numbers": torch.rand(1000, generator=draws),
        "steps": torch.arange(1000, dtype=torch.int32),
    }
    rows = torch.randint(0, 1000, (COUNT,), generator=draws)
    taken = take_rows(tensors, rows, threads)
    for name, tensor in tensors.items():
        assert torch.equal(taken[name], tensor[rows]) and taken[name].is_contiguous()
    assert [len(t) for t in take_rows(tensors, rows[:0], threads).values()] == [0, 0, 0]


@pytest.mark.parametrize("threads", [1, 16])
def test_rows_are_zeroed_in_the_result(threads: int) -> None:
    """In arrays of huge pages, too."""
    draws = torch.Generator().manual_seed(0)
    tensors = {"small": torch.rand(1000, generator=draws), "large": torch.rand(1000, 40)}
    rows = torch.randint(0, 1000, (COUNT,), generator=draws)
    zeroed = torch.rand(COUNT, generator=draws) < 0.3
    taken = take_rows(tensors, rows, threads, zeroed)
    for name, tensor in tensors.items():
        expected = tensor[rows]
        expected[zeroed] = 0.0
        assert torch.equal(taken[name], expected)


@pytest.mark.parametrize("threads", [2, 16, 64])
def test_the_order_in_space_does_not_depend_on_the_number_of_threads(threads: int) -> None:
    means = np.random.default_rng(0).normal(size=(COUNT, 3)).astype(np.float32)
    means[7:11] = means[-1]
    assert np.array_equal(z_order(means, threads), z_order(means))


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_in_one_range_is_raised(threads: int) -> None:
    def work(rows: slice) -> None:
        if rows.start:
            raise ValueError(f"rows from {rows.start}")

    with pytest.raises(ValueError, match=f"rows from {RANGE_ROWS}"):
        for_ranges(COUNT, threads, work)
