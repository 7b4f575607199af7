"""The GPU: choosing and opening a device, buffers, and running kernels."""

from __future__ import annotations

import contextlib
import os
import struct
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.render.gpu.counts import BindGroup, Counts
from pipeline.render.gpu.kernels import source, uses
from pipeline.runtime.errors import UserError
from pipeline.runtime.layout import install_extra

THREADS = 256  # kThreads in common.wgsl
SMALLEST = 256  # The bytes of a buffer: bindings must not be smaller than their struct.
MAX_UNIFORMS = 1024  # The number of uniforms that are kept.
MAX_GROUPS = 65535  # WebGPU's limit of workgroups in one dimension of a dispatch.
# The limits that the kernels need beyond WebGPU's defaults.
NEEDED = {
    "max-compute-workgroup-storage-size": 24 * 1024,
    "max-storage-buffers-per-shader-stage": 12,
}
SUBGROUPS = "subgroup"  # The feature with which prefix sums are faster.
OPTIONAL_FEATURES = ("timestamp-query", SUBGROUPS)
# Limits that are requested as far as the device has them: the size of a scene depends on them.
WANTED = ("max-buffer-size", "max-storage-buffer-binding-size")

SMALLER = (
    "lower train.density.max_gaussians or views.max_long_side_px, set partition.blocks, or set "
    "train.device: cpu"
)
NO_WGPU = f"{install_extra('gpu')}, or set train.device: cpu"
NO_GPU = (
    "install the GPU's driver with Vulkan (vulkaninfo lists devices), or set train.device: "
    "cpu; splatmake doctor shows what is found"
)

Buffer = Any  # wgpu.GPUBuffer: wgpu is imported only if a GPU is used.


@dataclass(frozen=True)
class Adapter:
    """A GPU of this machine.

    Attributes:
        number: The N of ``gpu:N``, which chooses the adapter.
        name, driver: The names that the driver reports.
        kind: ``discrete``, ``integrated``, ``software`` (the CPU) or ``unknown``.
        api: ``Vulkan``, ``Metal`` or ``D3D12``.
    """

    number: int
    name: str
    driver: str
    kind: str
    api: str

    def __str__(self) -> str:
        return f"{self.name} ({self.kind}, {self.api})"


def adapters() -> list[Adapter]:
    """The GPUs of this machine, the fastest kinds first; empty if there is none.

    Raises:
        UserError: the package wgpu is not installed.
    """
    return [
        Adapter(
            number,
            adapter.info["device"],
            adapter.info["description"],
            _kind(adapter),
            adapter.info["backend_type"],
        )
        for number, adapter in enumerate(_adapters())
    ]


class KernelTimer(Protocol):
    """An object that measures kernels (``benchmarks.kernel_times.Profile``)."""

    def timestamp_writes(self, kernel: str) -> dict[str, Any]:
        """Return the queries of the pass of the next kernel."""


class Gpu:
    """An open device.

    Kernels are named as their WGSL files; ``name.entry`` is another entry point than ``main``.

    Args:
        number: The N of ``gpu:N``.
        subgroups: Whether kernels use subgroups if the device has them; None: not in software,
            where they are slower. Results do not depend on it.

    Attributes:
        subgroups: Whether kernels use subgroups.
        counts: The work since the device was opened, or since a caller replaced the counts.

    Raises:
        UserError: there is no such device, or it lacks what the kernels need.
    """

    def __init__(self, number: int = 0, *, subgroups: bool | None = None):
        found = _adapters()
        if number >= len(found):
            raise UserError(f"no GPU {number}: {len(found)} found", fix=NO_GPU)
        adapter = found[number]
        self.adapter = adapters()[number]
        limits = adapter.limits
        for name, least in NEEDED.items():
            if limits[name] < least:
                raise UserError(
                    f"{self.adapter}: {name} is {limits[name]}, the kernels need {least}",
                    fix="use another GPU (gpu:N), or train.device: cpu",
                )
        requested = {name: limits[name] for name in (*NEEDED, *WANTED)}
        features = [name for name in OPTIONAL_FEATURES if name in adapter.features]
        self.device = adapter.request_device_sync(
            required_limits=requested, required_features=features
        )
        if subgroups is None:
            subgroups = self.adapter.kind != "software"
        self.subgroups = subgroups and SUBGROUPS in features
        self.max_bytes = min(limits[name] for name in WANTED)
        self._pipelines: dict[str, tuple[Any, Any]] = {}
        self._layouts: dict[str, tuple[Any, Any]] = {}
        self._placeholders: list[Buffer] = []
        self._uniforms: dict[bytes, Buffer] = {}
        self._encoder: Any = None
        self._pass: Any = None
        self.submissions = 0  # The number of submitted command buffers.
        self.counts = Counts()
        self.timer: KernelTimer | None = None

    # ---- Buffers ----

    def empty(self, size: int, *, what: str = "an array") -> Buffer:
        """A buffer of zeros of at least ``size`` bytes.

        Raises:
            UserError: The size exceeds the device's limit or its memory.
        """
        import wgpu

        size = max(SMALLEST, (size + 3) // 4 * 4)
        if size > self.max_bytes:
            raise too_large(what, size, self)
        usage = wgpu.BufferUsage
        try:
            return self.device.create_buffer(
                label=what,
                size=size,
                usage=usage.STORAGE | usage.UNIFORM | usage.COPY_SRC | usage.COPY_DST,
            )
        except (wgpu.GPUOutOfMemoryError, wgpu.GPUValidationError) as error:
            raise UserError(
                f"{self.adapter}: no memory for {what} of {size / 1e6:.0f} MB: {error}", fix=SMALLER
            ) from error

    def upload(self, array: NDArray[Any], *, what: str = "an array") -> Buffer:
        """A new buffer with the array's bytes."""
        buffer = self.empty(array.nbytes, what=what)
        self.write_now(buffer, array)
        return buffer

    def uniform(self, format: str, *values: float) -> Buffer:
        """A buffer of the fields of a struct, whose types are as in the module ``struct``; to be
        read only. Equal ones are made once."""
        packed = struct.pack("<" + format, *values)
        if packed not in self._uniforms:
            if len(self._uniforms) == MAX_UNIFORMS:
                self._uniforms.clear()
            self._uniforms[packed] = self.upload(np.frombuffer(packed, np.uint8))
        return self._uniforms[packed]

    def write(self, buffer: Buffer, array: NDArray[Any], offset: int = 0) -> None:
        """Copy an array into a buffer, after the kernels before. Its bytes are padded to a multiple
        of four."""
        self.submit()
        self.write_now(buffer, array, offset)

    def write_now(self, buffer: Buffer, array: NDArray[Any], offset: int = 0) -> None:
        """Copy an array as ``write`` does, but before the kernels that are not submitted yet."""
        data = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        if data.nbytes % 4:
            data = np.concatenate([data, np.zeros(-data.nbytes % 4, np.uint8)])
        if data.nbytes:
            self.counts.uploaded[buffer.label] += data.nbytes
            self.device.queue.write_buffer(buffer, offset, data)

    def copy(self, source: Buffer, start: int, target: Buffer, offset: int, size: int) -> None:
        """Record a copy of ``size`` bytes, from ``start`` on, to ``offset`` of another buffer."""
        self._end_pass()
        self.counts.add_copy(source, target, size)
        self._encode().copy_buffer_to_buffer(source, start, target, offset, size)

    def read(self, buffer: Buffer, dtype: Any, count: int, offset: int = 0) -> NDArray[Any]:
        """A copy of ``count`` numbers of a buffer; waits for the kernels before.

        Raises:
            UserError: The device is lost.
        """
        self.submit()
        size = count * np.dtype(dtype).itemsize
        if not size:
            return np.zeros(0, dtype)
        self.counts.waits += 1
        self.counts.downloaded[buffer.label] += size
        try:
            data = self.device.queue.read_buffer(buffer, offset, (size + 3) // 4 * 4)
        except Exception as error:
            raise UserError(
                f"{self.adapter} was lost: {error}",
                fix=f"start again: training resumes from its checkpoint. If it recurs, {SMALLER}",
            ) from error
        return np.frombuffer(data, np.uint8)[:size].view(dtype).copy()

    # ---- Kernels ----

    def run(self, kernel: str, groups: int | tuple[int, int, int], **buffers: Buffer) -> None:
        """Record a kernel; it runs after those recorded before.

        Args:
            groups: The number of workgroups of ``THREADS`` threads. A single number may exceed the
                limit of one dimension.
            buffers: The buffers by the names of the kernel's bindings. The kernel does not use
                bindings that are missing here.
        """
        self.dispatch(kernel, groups, self.bind(kernel, buffers))

    def bind(self, kernel: str, buffers: Mapping[str, Buffer]) -> BindGroup:
        """The bind group of a kernel's buffers, by the names of its bindings."""
        _, layout = self._pipeline(kernel)
        bindings = source(kernel.partition(".")[0]).bindings
        unknown = buffers.keys() - {binding.name for binding in bindings}
        assert not unknown, f"{kernel} has no bindings {', '.join(unknown)}"
        entries = []
        for binding in bindings:
            buffer = buffers.get(binding.name) or self._placeholder(binding.number)
            resource = {"buffer": buffer, "offset": 0, "size": buffer.size}
            entries.append({"binding": binding.number, "resource": resource})
        group = self.device.create_bind_group(layout=layout, entries=entries)
        used = uses(kernel)
        return BindGroup(group, tuple((used[name], buffer) for name, buffer in buffers.items()))

    def dispatch(
        self,
        kernel: str,
        groups: int | tuple[int, int, int],
        bound: BindGroup,
        share: float = 1.0,
    ) -> None:
        """Record a kernel with the result of ``bind``; ``share`` as of ``Workspace.run``."""
        if groups == 0:
            return
        if isinstance(groups, int):
            across = min(groups, MAX_GROUPS)
            groups = across, -(-groups // across), 1
        if self.timer is not None:
            self._end_pass()
            writes = self.timer.timestamp_writes(kernel)
            self._pass = self._encode().begin_compute_pass(timestamp_writes=writes)
        elif self._pass is None:
            self._pass = self._encode().begin_compute_pass()
        self._pass.set_pipeline(self._pipeline(kernel)[0])
        self._pass.set_bind_group(0, bound.group)
        self._pass.dispatch_workgroups(*groups)
        self.counts.add_dispatch(bound, share)

    def clear(self, buffer: Buffer) -> None:
        """Fill a buffer with zeros."""
        self._end_pass()
        self.counts.add_copy(None, buffer, buffer.size)
        self._encode().clear_buffer(buffer)

    def submit(self) -> None:
        """Start the recorded kernels."""
        self._end_pass()
        encoder, self._encoder = self._encoder, None
        if encoder is not None:
            self.submissions += 1
            self.counts.submissions += 1
            self.device.queue.submit([encoder.finish()])

    def _encode(self) -> Any:
        if self._encoder is None:
            self._encoder = self.device.create_command_encoder()
        return self._encoder

    def _end_pass(self) -> None:
        if self._pass is not None:
            self._pass.end()
            self._pass = None

    def _placeholder(self, number: int) -> Buffer:
        # There is one for each binding: a buffer cannot be bound twice if a kernel may write to it.
        while len(self._placeholders) <= number:
            self._placeholders.append(self.empty(256))
        return self._placeholders[number]

    def _pipeline(self, kernel: str) -> tuple[Any, Any]:
        if kernel not in self._pipelines:
            name, _, entry = kernel.partition(".")
            if name not in self._layouts:
                self._layouts[name] = self._make_layout(name)
            layout, module = self._layouts[name]
            pipeline = self.device.create_compute_pipeline(
                layout=self.device.create_pipeline_layout(bind_group_layouts=[layout]),
                compute={"module": module, "entry_point": entry or "main"},
            )
            self._pipelines[kernel] = pipeline, layout
        return self._pipelines[kernel]

    def _make_layout(self, name: str) -> tuple[Any, Any]:
        import wgpu

        types = {"uniform": "uniform", "read": "read-only-storage", "read_write": "storage"}
        entries = [
            {
                "binding": binding.number,
                "visibility": wgpu.ShaderStage.COMPUTE,
                "buffer": {"type": types[binding.kind]},
            }
            for binding in source(name).bindings
        ]
        code = source(name, self.subgroups).code
        module = self.device.create_shader_module(label=name, code=code)
        return self.device.create_bind_group_layout(entries=entries), module


def too_large(what: str, size: int, gpu: Gpu) -> UserError:
    """The error for an array of so many bytes."""
    holds = f"a buffer of {gpu.adapter} holds {gpu.max_bytes / 1e6:.0f} MB"
    return UserError(f"{what}: {size / 1e6:.0f} MB; {holds}", fix=SMALLER)


def blocks(count: int, size: int = THREADS) -> int:
    """The number of workgroups for ``count`` elements, ``size`` each."""
    return -(-count // size)


@cache
def _adapters() -> list[Any]:
    try:
        import wgpu
        from wgpu.backends.wgpu_native.extras import set_instance_extras
    except ImportError as error:
        raise UserError("the package wgpu is not installed", fix=NO_WGPU) from error
    # Without a desktop, drivers write a line to stderr for each device.
    os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())
    # OpenGL lacks what the kernels need.
    with contextlib.suppress(RuntimeError):  # Another library may have used wgpu before.
        set_instance_extras(backends=["Vulkan", "Metal", "DX12"])
    found = wgpu.gpu.enumerate_adapters_sync()
    kinds = ["discrete", "integrated", "unknown", "software"]
    return sorted(found, key=lambda adapter: kinds.index(_kind(adapter)))


def _kind(adapter: Any) -> str:
    kind = adapter.info["adapter_type"]
    names = {"DiscreteGPU": "discrete", "IntegratedGPU": "integrated", "CPU": "software"}
    return names.get(kind, "unknown")
