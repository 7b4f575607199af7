"""Prefix sums and sorting on a GPU, with subgroups and without."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.render.gpu.device import Gpu, blocks
from pipeline.render.gpu.primitives import BLOCK, scan, sort
from pipeline.render.gpu.workspace import Workspace
from tests.tools import need_gpu


@pytest.fixture(scope="module", params=[True, False], ids=["subgroups", "without"])
def gpu(request: pytest.FixtureRequest) -> Gpu:
    need_gpu()
    device = Gpu(subgroups=request.param)
    if request.param and not device.subgroups:
        pytest.skip(f"{device.adapter} has no subgroups")
    return device


@pytest.mark.parametrize("columns", [1, 5, 256, 2047, 2049, 5000])
def test_rows_are_replaced_by_their_prefix_sums(gpu: Gpu, columns: int) -> None:
    """Columns beyond the number of elements stay as they are."""
    rows = np.random.default_rng(columns).integers(0, 9, (3, columns + 2)).astype(np.uint32)
    buffer, totals = gpu.upload(rows), gpu.upload(np.zeros(3, np.uint32))
    length = gpu.upload(np.array([BLOCK * (columns - 1) + 1], np.uint32))
    scan(Workspace(gpu), buffer, 3, length, columns + 2, totals)
    expected, used = rows.copy(), rows[:, :columns]
    expected[:, :columns] = used.cumsum(1) - used
    assert (gpu.read(buffer, np.uint32, rows.size).reshape(rows.shape) == expected).all()
    assert (gpu.read(totals, np.uint32, 3) == used.sum(1)).all()


@pytest.mark.parametrize(
    ("length", "capacity", "bits"),
    [
        (0, 4, 32), (1, 1, 4), (1000, 1024, 13), (2048, 2048, 8), (2049, 9000, 3), (5000, 9000, 32),
        (70_000, 70_000, 9), (300_000, 400_000, 17), (30_000, 30_000, 31),
    ],
)  # fmt: skip
@pytest.mark.parametrize("kept", [1.0, 0.6], ids=["all", "some"])
def test_sorting_is_stable(gpu: Gpu, length: int, capacity: int, bits: int, kept: float) -> None:
    """Keys of zero are left out."""
    rng = np.random.default_rng(length)
    keys = rng.integers(1, 1 << bits, capacity, dtype=np.uint64).astype(np.uint32)
    keys[::3] = keys[0]  # equal keys
    keys[rng.random(capacity) > kept] = 0
    size = gpu.upload(np.array([length], np.uint32))
    order = np.argsort(keys[:length], kind="stable")
    order = order[keys[order] > 0]
    found = sort(Workspace(gpu), "test", gpu.upload(keys), size, capacity=capacity, bits=bits)
    assert gpu.read(found.count, np.uint32, 1)[0] == len(order)
    assert (gpu.read(found.order, np.uint32, len(order)) == order).all()
    assert (gpu.read(found.keys, np.uint32, len(order)) == keys[order]).all()


def test_keys_that_share_a_digit_are_sorted(gpu: Gpu) -> None:
    """All keys of several blocks go to one place, or to two."""
    keys = np.full(3 * BLOCK + 5, 0xFF00, np.uint32)
    for changed in (0, 1):
        keys[BLOCK : BLOCK + changed] = 1
        size = gpu.upload(np.array([keys.size], np.uint32))
        found = sort(Workspace(gpu), "test", gpu.upload(keys), size, capacity=keys.size, bits=16)
        order = np.argsort(keys, kind="stable")
        assert (gpu.read(found.order, np.uint32, keys.size) == order).all()


def test_a_sort_takes_three_dispatches_for_eight_bits(gpu: Gpu) -> None:
    for bits, passes in ((4, 1), (8, 1), (13, 2), (31, 4)):
        before = gpu.counts.dispatches
        keys = gpu.upload(np.arange(1, 100_000, dtype=np.uint32))
        size = gpu.upload(np.array([keys.size // 4], np.uint32))
        sort(Workspace(gpu), "test", keys, size, capacity=100_000, bits=bits)
        assert gpu.counts.dispatches - before == 3 * passes
    assert blocks(100_000, BLOCK) > 1
