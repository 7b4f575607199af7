"""Counts of the work that a device is given: waits, dispatches and bytes."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from pipeline.render.gpu.kernels import Binding


@dataclass(frozen=True, eq=False)
class BindGroup:
    """The buffers of a kernel.

    Attributes:
        group: The ``wgpu.GPUBindGroup``.
        buffers: The buffers with their bindings, without placeholders.
    """

    group: Any
    buffers: tuple[tuple[Binding, Any], ...]


@dataclass
class Counts:
    """The work since the counts were made.

    Bytes are those of whole buffers: a kernel that is bound to a buffer counts as if it read or
    wrote each byte once. Kernels that gather the same record several times read more, and kernels
    that leave early less.

    Attributes:
        waits: The number of times that the processor waited for the device.
        dispatches: The number of dispatched kernels.
        copies: The number of copies and clears of buffers, which interrupt a pass.
        submissions: The number of submitted command buffers.
        uploaded, downloaded: Bytes copied to the device and from it.
        groups: The number of dispatches with each bind group; None: they are not counted, since
            that keeps the memory of their buffers.
        copied, cleared: The bytes that copies read, and those that copies and clears write.
    """

    waits: int = 0
    dispatches: int = 0
    copies: int = 0
    submissions: int = 0
    uploaded: int = 0
    downloaded: int = 0
    groups: Counter[BindGroup] | None = None
    copied: Counter[str] = field(default_factory=Counter)
    cleared: Counter[str] = field(default_factory=Counter)

    def traffic(self) -> tuple[Counter[str], Counter[str]]:
        """The bytes of the device's memory that are read and written, by the names of buffers."""
        read, written = Counter(self.copied), self.cleared.copy()
        assert self.groups is not None
        for group, times in self.groups.items():
            for binding, buffer in group.buffers:
                if binding.kind == "read_write":
                    written[buffer.label] += times * buffer.size
                if not binding.only_written:
                    read[buffer.label] += times * buffer.size
        return read, written

    def add_dispatch(self, group: BindGroup) -> None:
        """Count a kernel with its buffers."""
        self.dispatches += 1
        if self.groups is not None:
            self.groups[group] += 1

    def add_copy(self, source: Any, target: Any, size: int) -> None:
        """Count a copy; ``source`` is None if the buffer is cleared."""
        self.copies += 1
        if source is not None:
            self.copied[source.label] += size
        self.cleared[target.label] += size
