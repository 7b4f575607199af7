"""Counts of the work that a device is given: waits, dispatches and bytes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from pipeline.render.gpu.kernels import Binding


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
        read, written: The bytes of the device's memory, by the names of the buffers.
    """

    waits: int = 0
    dispatches: int = 0
    copies: int = 0
    submissions: int = 0
    uploaded: int = 0
    downloaded: int = 0
    read: Counter[str] = field(default_factory=Counter)
    written: Counter[str] = field(default_factory=Counter)

    @property
    def bytes(self) -> int:
        """The bytes of the device's memory that are read and written."""
        return self.read.total() + self.written.total()

    def add_dispatch(self, bound: Iterable[tuple[Binding, Any]]) -> None:
        """Count a kernel with its buffers."""
        self.dispatches += 1
        for binding, buffer in bound:
            if binding.kind == "read_write":
                self.written[buffer.label] += buffer.size
            if not binding.only_written:
                self.read[buffer.label] += buffer.size

    def add_copy(self, source: Any, target: Any, size: int) -> None:
        """Count a copy; ``source`` is None if the buffer is cleared."""
        self.copies += 1
        if source is not None:
            self.read[source.label] += size
        self.written[target.label] += size
