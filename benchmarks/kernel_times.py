"""Times of kernels on the device, by timestamp queries."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from pipeline.render.gpu.device import Gpu
from pipeline.runtime.errors import UserError

MAX_KERNELS = 2048  # Kernels between two collections: half of the limit of a query set.


class Profile:
    """Measures each kernel in a pass of its own.

    Attributes:
        seconds: The sum of each kernel's times since the start, by name.
    """

    def __init__(self, gpu: Gpu):
        if "timestamp-query" not in gpu.device.features:
            raise UserError(f"{gpu.adapter} has no timestamps", fix="measure another device")
        self.gpu = gpu
        self.seconds: dict[str, float] = defaultdict(float)
        self._queries = gpu.device.create_query_set(type="timestamp", count=2 * MAX_KERNELS)
        self._kernels: list[str] = []

    def timestamp_writes(self, kernel: str) -> dict[str, Any]:
        """Return the queries of the pass of the next kernel."""
        if len(self._kernels) == MAX_KERNELS:
            raise UserError("too many kernels between two collections", fix="collect more often")
        first = 2 * len(self._kernels)
        self._kernels.append(kernel)
        return {
            "query_set": self._queries,
            "beginning_of_pass_write_index": first,
            "end_of_pass_write_index": first + 1,
        }

    def collect(self) -> None:
        """Add the times of the kernels since the last collection."""
        import wgpu

        if not self._kernels:
            return
        self.gpu.submit()
        device, count = self.gpu.device, 2 * len(self._kernels)
        usage = wgpu.BufferUsage.QUERY_RESOLVE | wgpu.BufferUsage.COPY_SRC
        buffer = device.create_buffer(size=8 * count, usage=usage)
        encoder = device.create_command_encoder()
        encoder.resolve_query_set(self._queries, 0, count, buffer, 0)
        device.queue.submit([encoder.finish()])
        ticks = np.frombuffer(device.queue.read_buffer(buffer), np.uint64).reshape(-1, 2)
        each = (ticks[:, 1] - ticks[:, 0]).astype(np.int64) * seconds_per_tick(self.gpu)
        for kernel, seconds in zip(self._kernels, each, strict=True):
            self.seconds[kernel] += float(seconds)
        self._kernels.clear()


@contextmanager
def profiled(gpu: Gpu) -> Iterator[Profile]:
    """Measure the kernels that run inside."""
    gpu.submit()
    gpu.timer = profile = Profile(gpu)
    try:
        yield profile
        profile.collect()
    finally:
        gpu.timer = None


def seconds_per_tick(gpu: Gpu) -> float:
    """Return the unit of timestamps: WebGPU's are in nanoseconds, wgpu-native's in the device's."""
    from wgpu.backends.wgpu_native import lib

    return 1e-9 * float(lib.wgpuQueueGetTimestampPeriod(gpu.device.queue._internal))
