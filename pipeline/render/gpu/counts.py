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
    that gather the same record several times read more, and kernels that leave early less. The
    bands of an image, which are dispatches of their own, count together once: each by its share of
    the tiles. Of the arrays of pairs, the bytes of ``Counts.pairs`` pairs are in use.

    Attributes:
        used: The bytes of the buffers in use, where these are fewer than all.
    """

    read: Counter[str] = field(default_factory=Counter)
    written: Counter[str] = field(default_factory=Counter)
    used: dict[str, int] = field(default_factory=dict)

    @property
    def total(self) -> int:
        return self.read.total() + self.written.total()

    def add_kernel(self, group: BindGroup, share: float) -> None:
        for use, buffer in group.buffers:
            used = min(buffer.size, self.used.get(buffer.label, buffer.size))
            size = round(share * used)
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
        uploaded, downloaded: Bytes copied to the device and from it, by the names of the buffers.
        pairs: The number of (Gaussian, tile) pairs of the last step whose results were read; None:
            it is not known, and arrays of pairs count with all their room.
        traffic: None: it is not counted, which takes time.
    """

    waits: int = 0
    dispatches: int = 0
    copies: int = 0
    submissions: int = 0
    uploaded: Counter[str] = field(default_factory=Counter)
    downloaded: Counter[str] = field(default_factory=Counter)
    pairs: int | None = None
    traffic: Traffic | None = None

    def use(self, name: str, size: int) -> None:
        """Note how many bytes of a buffer the next kernels use."""
        if self.traffic is not None:
            self.traffic.used[name] = size

    def listed(self, capacity: int) -> int:
        """The number of pairs in use in arrays with room for ``capacity``."""
        return capacity if self.pairs is None else min(self.pairs, capacity)

    def add_dispatch(self, group: BindGroup, share: float) -> None:
        """Count a kernel that uses this share of its buffers."""
        self.dispatches += 1
        if self.traffic is not None:
            self.traffic.add_kernel(group, share)

    def add_copy(self, source: Any, target: Any, size: int) -> None:
        """Count a copy; ``source`` is None if the buffer is cleared."""
        self.copies += 1
        if self.traffic is not None:
            self.traffic.written[target.label] += size
            if source is not None:
                self.traffic.read[source.label] += size
