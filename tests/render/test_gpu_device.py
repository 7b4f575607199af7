"""Opening a GPU, its limits, and errors that say what to do."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.kernel_times import profiled
from pipeline.render import RasterOptions, make_backend
from pipeline.render.gpu import device, kernels, rasterise
from pipeline.render.gpu.backend import GpuBackend
from pipeline.render.gpu.device import Gpu
from pipeline.render.gpu.memory import memory_line, training_bytes
from pipeline.render.gpu.primitives import scan, sort
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.resident import TrainingSize
from pipeline.runtime.errors import UserError
from tests.render.scenes import camera, random_scene
from tests.tools import need_gpu

LARGE = TrainingSize(1_000_000, 16, 1600 * 1067, 3 * 200 * 1600 * 1067)


@pytest.fixture(scope="module")
def gpu() -> Gpu:
    need_gpu()
    backend = make_backend("gpu")
    assert isinstance(backend, GpuBackend)
    return backend.gpu


def test_a_gpu_that_is_not_there_is_an_error() -> None:
    need_gpu()
    with pytest.raises(UserError, match="no GPU 7") as error:
        make_backend("gpu:7").facts()
    assert "doctor" in str(error.value.fix)
    with pytest.raises(ValueError, match="no backend 'gpu:x'"):
        make_backend("gpu:x")


def test_without_wgpu_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "wgpu", None)
    device._adapters.cache_clear()
    try:
        with pytest.raises(UserError, match="wgpu is not installed") as error:
            Gpu()
    finally:
        device._adapters.cache_clear()
    assert ".[gpu]" in str(error.value.fix)


def test_the_memory_of_a_large_scene_is_known_before(gpu: Gpu) -> None:
    """One million Gaussians of SH degree 3, images of 1600 pixels."""
    assert training_bytes(LARGE, cached=0) == pytest.approx(1.6e9, rel=0.1)
    assert training_bytes(LARGE, cached=1 << 40) > training_bytes(LARGE, cached=0) + 1e9
    text = memory_line(gpu, TrainingSize(50_000, 16, 640 * 480, 10**7), cached=1 << 30)
    assert "for up to 50000 Gaussians and images of 0.31 megapixels" in text


def test_a_limit_that_is_exceeded_names_the_options(
    gpu: Gpu, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The smallest limit of WebGPU is 128 MB for one buffer."""
    monkeypatch.setattr(gpu, "max_bytes", 128 << 20)
    with pytest.raises(UserError, match=r"slots of gradients: 320 MB; .* holds 134 MB") as error:
        memory_line(gpu, LARGE, cached=0)
    assert "train.density.max_gaussians" in str(error.value.fix)
    with pytest.raises(UserError, match=r"an array: 135 MB"):
        gpu.empty(135_000_000)
    space = Workspace(gpu)
    space.get("grows", 100 << 20)
    assert space.get("grows", 120 << 20).size == 128 << 20, "no more than the device allows"


def test_bands_of_tiles_give_the_same_bits(gpu: Gpu, monkeypatch: pytest.MonkeyPatch) -> None:
    backend, scene, view = make_backend("gpu"), random_scene(1, 300), camera(70, 90)
    results = []
    for tiles in (10**6, 7):
        monkeypatch.setattr(rasterise, "TILES_OF_BAND", tiles)
        drawn = backend.forward(*scene, view, RasterOptions())
        found = backend.backward(drawn, torch.ones(90, 70, 3))
        results.append([drawn.color, drawn.depth, found.means, found.sh])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_a_lost_device_is_an_error(gpu: Gpu, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(*args: object) -> None:
        raise RuntimeError("Parent device is lost")

    buffer = gpu.empty(64)
    monkeypatch.setattr(type(gpu.device.queue), "read_buffer", lost)
    with pytest.raises(UserError, match="was lost: Parent device is lost") as error:
        gpu.read(buffer, np.float32, 4)
    assert "resumes from its checkpoint" in str(error.value.fix)


@pytest.mark.parametrize("count", [1, 5, 255, 1024, 1025, 70_000, 1_100_000])
def test_prefix_sums(gpu: Gpu, count: int) -> None:
    values = np.random.default_rng(count).integers(0, 9, count).astype(np.uint32)
    buffer = gpu.upload(values)
    scan(Workspace(gpu), buffer, count)
    expected = np.cumsum(values) - values
    assert (gpu.read(buffer, np.uint32, count) == expected).all()


@pytest.mark.parametrize(
    ("length", "capacity", "bits"),
    [(0, 4, 32), (1, 1, 4), (1000, 1024, 13), (5000, 9000, 32), (70_000, 70_000, 9)],
)
def test_sorting_is_stable(gpu: Gpu, length: int, capacity: int, bits: int) -> None:
    rng = np.random.default_rng(length)
    keys = rng.integers(0, 1 << bits, capacity, dtype=np.uint64).astype(np.uint32)
    keys[::3] = keys[0]  # equal keys
    values = np.arange(capacity, dtype=np.uint32)
    size = gpu.upload(np.array([length], np.uint32))
    buffers = gpu.upload(keys), gpu.upload(values), size
    found = sort(Workspace(gpu), *buffers, capacity=capacity, bits=bits)
    order = np.argsort(keys[:length], kind="stable")
    assert (gpu.read(found[0], np.uint32, length) == keys[order]).all()
    assert (gpu.read(found[1], np.uint32, length) == order).all()


def test_a_workspace_keeps_what_recorded_kernels_read(gpu: Gpu) -> None:
    """A uniform that changes before its kernel is submitted, and a buffer that grows between two
    uses of the same kernel."""
    space = Workspace(gpu)
    values = np.arange(2000, dtype=np.uint32)
    for count in (3, 2000, 7):
        buffer = space.get("values", 4 * count)
        gpu.write(buffer, values[:count])
        sums = space.get("sums", 64)
        for part in (count // 2, count):
            size = space.uniform("size", "I", part)
            space.run("scan.blocks", 1, size=size, values=buffer, sums=sums)
        half = count // 2
        once = np.concatenate([np.cumsum(values[:half]) - values[:half], values[half:count]])
        part = min(count, 1024)
        expected = once.astype(np.uint32)
        expected[:part] = np.cumsum(once[:part]) - once[:part]
        assert (gpu.read(buffer, np.uint32, count) == expected).all(), count


def test_kernels_are_timed_one_by_one(gpu: Gpu) -> None:
    with profiled(gpu) as profile:
        for _ in range(3):
            scan(Workspace(gpu), gpu.upload(np.ones(5000, np.uint32)), 5000)
            profile.collect()
    assert set(profile.seconds) == {"scan.blocks", "scan.add"}
    assert 0 < profile.seconds["scan.blocks"] < 10
    assert gpu.timer is None


def test_the_constants_are_those_of_the_cpp_kernels() -> None:
    text = kernels.constants()
    assert "const kAlphaMin = 1.0 / 255.0;" in text
    assert "const kTile = 16u;" in text
    assert len(text.splitlines()) == len(kernels.SHARED)


def test_each_kernel_declares_its_bindings_in_order() -> None:
    names = [file.stem for file in kernels.FOLDER.glob("*.wgsl")]
    found = {name: kernels.source(name).bindings for name in names}
    kinds = [b.kind for b in found["blend"]]
    assert kinds == ["uniform"] + 4 * ["read"] + 3 * ["read_write"] + ["uniform"]
    for name, bindings in found.items():
        assert [b.number for b in bindings] == list(range(len(bindings))), name
        storage = sum(b.kind != "uniform" for b in bindings)
        assert storage <= device.NEEDED["max-storage-buffers-per-shader-stage"], name
