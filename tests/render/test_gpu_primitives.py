"""Sorting and prefix sums on a GPU, with subgroups and without."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.render import RasterOptions
from pipeline.render.gpu.backend import GpuBackend
from pipeline.render.gpu.device import Gpu
from pipeline.render.gpu.primitives import BLOCK, sort
from pipeline.render.gpu.workspace import Workspace
from tests.render.scenes import camera, random_scene
from tests.tools import need_gpu


def open_gpu(subgroups: bool) -> Gpu:
    need_gpu()
    device = Gpu(subgroups=subgroups)
    if device.subgroups != subgroups:
        pytest.skip(f"{device.adapter} has no subgroups")
    return device


@pytest.fixture(scope="module", params=[True, False], ids=["subgroups", "without"])
def gpu(request: pytest.FixtureRequest) -> Gpu:
    return open_gpu(request.param)


def assert_sorts(gpu: Gpu, keys: NDArray[np.uint32], length: int, bits: int) -> None:
    """``keys`` is as long as the capacity."""
    size, order = gpu.uniform("I", length), np.argsort(keys[:length], kind="stable")
    order = order[keys[order] > 0]
    found = sort(Workspace(gpu), "test", gpu.upload(keys), size, capacity=keys.size, bits=bits)
    assert gpu.read(found.count, np.uint32, 1)[0] == len(order)
    assert (gpu.read(found.order, np.uint32, len(order)) == order).all()
    assert (gpu.read(found.keys, np.uint32, len(order)) == keys[order]).all()


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
    keys[rng.random(capacity) >= kept] = 0
    assert_sorts(gpu, keys, length, bits)


@given(data=st.data(), count=st.integers(0, 3 * BLOCK), bits=st.integers(1, 32))
@settings(max_examples=30, deadline=None)
def test_any_keys_are_sorted(gpu: Gpu, data: st.DataObject, count: int, bits: int) -> None:
    """Keys of few or many values, which agree in some digits."""
    values = data.draw(st.lists(st.integers(0, (1 << bits) - 1), min_size=1, max_size=20))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    length = data.draw(st.integers(0, count))
    assert_sorts(gpu, rng.choice(np.array(values, np.uint32), count), length, bits)


@pytest.mark.parametrize("changed", [0, 1, BLOCK])
def test_keys_that_share_a_digit_are_sorted(gpu: Gpu, changed: int) -> None:
    """All keys of several blocks go to one place, or to two."""
    keys = np.full(3 * BLOCK + 5, 0xFF00, np.uint32)
    keys[BLOCK : BLOCK + changed] = 1
    assert_sorts(gpu, keys, keys.size, 16)


def test_a_sort_takes_three_dispatches_for_eight_bits(gpu: Gpu) -> None:
    for bits, passes in ((4, 1), (8, 1), (13, 2), (31, 4)):
        before = gpu.counts.dispatches
        assert_sorts(gpu, np.ones(3 * BLOCK, np.uint32), 3 * BLOCK, bits)
        assert gpu.counts.dispatches - before == 3 * passes


@pytest.mark.parametrize("groups", [1, 5, 256, 2048, 2049, 5000])
def test_pairs_are_numbered_through_all_blocks(gpu: Gpu, groups: int) -> None:
    pairs = np.random.default_rng(groups).integers(0, 9, groups).astype(np.uint32)
    before, results = gpu.upload(pairs), gpu.upload(np.zeros(6, np.uint32))
    visible, one = BLOCK * (groups - 1) + 1, gpu.upload(np.ones(1, np.uint32))
    gpu.run(
        "admit", 1, size=gpu.uniform("II", 1 << 20, 2), num_visible=gpu.uniform("I", visible),
        before=before, dropped=one, stopped=gpu.empty(4), length=gpu.empty(4), results=results,
    )  # fmt: skip
    assert (gpu.read(before, np.uint32, groups) == pairs.cumsum() - pairs).all()
    assert gpu.read(results, np.uint32, 6).tolist() == [0, 0, 0, pairs.sum(), visible, 1]


def test_images_do_not_depend_on_subgroups() -> None:
    """To the bit, of several blocks of Gaussians and pairs."""
    scene, found = random_scene(5, 6000), []
    for subgroups in (True, False):
        backend = GpuBackend()
        backend.gpu = open_gpu(subgroups)
        found.append(backend.forward(*scene, camera(180, 90), RasterOptions()))
    assert found[0].num_visible > 2 * BLOCK and found[0].num_intersections > 4 * BLOCK
    assert found[0].num_intersections == found[1].num_intersections
    assert torch.equal(found[0].color, found[1].color)
    assert torch.equal(found[0].alpha, found[1].alpha)
