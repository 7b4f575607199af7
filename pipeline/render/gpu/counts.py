"""Counts of the work that a device is given: waits, dispatches and bytes."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from pipeline.render.gpu.kernels import Use


@dataclass(frozen=True, eq=False)
class BindGroup:
    """The buffers of a kernel.

    Attributes:
        group: The ``wgpu.GPUBindGroup``.
        buffers: The buffers with their uses, without placeholders.
    """

    group: Any
    buffers: tuple[tuple[Use, Any], ...]


@dataclass
class Traffic:
    """The bytes of the device's memory that kernels and copies read and write, by the names of the
    buffers.

    A kernel that uses a buffer counts as if it read or wrote each byte in use once. Kernels
    that gather the same record several times read more, and kernels that leave early less.

    Attributes:
        used: The bytes of the buffers in use, where these are fewer than all.
    """

    read: Counter[str] = field(default_factory=Counter)
    written: Counter[str] = field(default_factory=Counter)
    used: dict[str, int] = field(default_factory=dict)

    @property
    def total(self) -> int:
        return self.read.total() + self.written.total()

    def add_kernel(self, group: BindGroup) -> None:
        for use, buffer in group.buffers:
            size = min(buffer.size, self.used.get(buffer.label, buffer.size))
            if use.written:
                self.written[buffer.label] += size
            if use.read:
                self.read[buffer.label] += size


@dataclass
class Counts:
    """The work since the counts were made.

    Attributes:
        waits: The number of times that the processor waited for the device.
        dispatches: The number of dispatched kernels.
        copies: The number of copies and clears of buffers, which interrupt a pass.
        submissions: The number of submitted command buffers.
        uploaded, downloaded: Bytes copied to the device and from it.
        traffic: None: it is not counted, which takes time.
    """

    waits: int = 0
    dispatches: int = 0
    copies: int = 0
    submissions: int = 0
    uploaded: int = 0
    downloaded: int = 0
    traffic: Traffic | None = None

    def use(self, name: str, size: int) -> None:
        """Note how many bytes of a buffer the next kernels use."""
        if self.traffic is not None:
            self.traffic.used[name] = size

    def add_dispatch(self, group: BindGroup) -> None:
        """Count a kernel with its buffers."""
        self.dispatches += 1
        if self.traffic is not None:
            self.traffic.add_kernel(group)

    def add_copy(self, source: Any, target: Any, size: int) -> None:
        """Count a copy; ``source`` is None if the buffer is cleared."""
        self.copies += 1
        if self.traffic is not None:
            self.traffic.written[target.label] += size
            if source is not None:
                self.traffic.read[source.label] += size
