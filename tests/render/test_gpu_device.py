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
from pipeline.render.gpu.primitives import sort
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
    assert training_bytes(LARGE, cached=0) == pytest.approx(1.4e9, rel=0.1)
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


def test_pairs_that_are_not_listed_are_not_counted(gpu: Gpu) -> None:
    """Kernels may round differently: here, each Gaussian was counted in one tile too many."""
    backend, scene, view = make_backend("gpu"), random_scene(1, 300), camera(70, 90)
    assert isinstance(backend, GpuBackend)
    expected = backend.forward(*scene, view, RasterOptions())
    projected = backend.project(scene, view, RasterOptions())
    counts = gpu.read(projected.projection.tile_counts, np.uint32, 300)
    gpu.write(projected.projection.tile_counts, counts + (counts > 0).astype(np.uint32))
    drawn = backend.blend(backend.bin(projected))
    assert drawn.num_intersections == expected.num_intersections + (counts > 0).sum()
    assert torch.equal(drawn.color, expected.color)
    assert (gpu.read(projected.projection.tile_counts, np.uint32, 300) == counts).all()


def test_a_lost_device_is_an_error(gpu: Gpu, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(*args: object) -> None:
        raise RuntimeError("Parent device is lost")

    buffer = gpu.empty(64)
    monkeypatch.setattr(type(gpu.device.queue), "read_buffer", lost)
    with pytest.raises(UserError, match="was lost: Parent device is lost") as error:
        gpu.read(buffer, np.float32, 4)
    assert "resumes from its checkpoint" in str(error.value.fix)


def test_a_workspace_keeps_what_recorded_kernels_read(gpu: Gpu) -> None:
    """A uniform that changes before its kernel is submitted, and a buffer that grows between two
    uses of the same kernel."""
    space = Workspace(gpu)
    values = np.arange(1000, dtype=np.float32)
    for count in (3, 1000, 7):
        buffer = space.get("values", 4 * count)
        gpu.write(buffer, values[:count])
        sums, parts = space.get("sums", 64), (count // 2, count)
        for at, part in enumerate(parts):
            size = space.uniform("size", "III", part, 1, at)
            space.run("sum_rows", 1, size=size, values=buffer, sums=sums)
        expected = [values[:part].sum() for part in parts]
        assert gpu.read(sums, np.float32, 2).tolist() == expected, count


def test_kernels_are_timed_one_by_one(gpu: Gpu) -> None:
    with profiled(gpu) as profile:
        for _ in range(3):
            keys, length = gpu.upload(np.ones(5000, np.uint32)), gpu.uniform("I", 5000)
            sort(Workspace(gpu), "test", keys, length, capacity=5000, bits=8)
            profile.collect()
    assert set(profile.seconds) == {"sort.histogram", "sort.scan", "sort.scatter"}
    assert 0 < profile.seconds["sort.scan"] < 10
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
