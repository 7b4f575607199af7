"""Buffers by name that are used again, and the bind groups of kernels that use them."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from pipeline.render.gpu.counts import BindGroup
from pipeline.render.gpu.device import Buffer, Gpu

GROWTH = 1.25  # The factor over the needed size if a buffer is replaced by a larger one.
MAX_GROUPS = 1024  # The number of bind groups that are kept.


class Workspace:
    """Buffers of one owner. Their contents are undefined when they are requested."""

    def __init__(self, gpu: Gpu):
        self.gpu = gpu
        self._buffers: dict[str, Buffer] = {}
        self._uniforms: dict[str, tuple[bytes, int]] = {}
        # Groups keep their buffers, whose ids are the keys.
        self._groups: dict[tuple[Any, ...], BindGroup] = {}

    def get(self, name: str, size: int, used: int | None = None) -> Buffer:
        """The buffer of this name, with at least ``size`` bytes.

        Args:
            used: The bytes that the next kernels use, for the counts; None: all.
        """
        self.gpu.counts.use(name, size if used is None else used)
        found = self._buffers.get(name)
        if found is None or found.size < size:
            grown = size if found is None else min(int(GROWTH * size), self.gpu.max_bytes)
            self.release_groups()
            found = self._buffers[name] = self.gpu.empty(max(size, grown), what=name)
        return found

    def release_groups(self) -> None:
        """Make all bind groups anew: they hold a buffer that was replaced."""
        self._groups.clear()

    def uniform(self, name: str, format: str, *values: float) -> Buffer:
        """The buffer of this name with the fields of a struct, whose types are as in the module
        ``struct``."""
        return self.write_uniform(name, struct.pack("<" + format, *values))

    def write_uniform(self, name: str, packed: bytes) -> Buffer:
        """The buffer of this name with these bytes, for kernels that are recorded from now on."""
        buffer = self.get(name, len(packed))
        before, used = self._uniforms.get(name, (b"", -1))
        if packed != before:
            if used == self.gpu.submissions:
                self.gpu.submit()  # A recorded kernel may read the bytes before.
            self.gpu.write_now(buffer, np.frombuffer(packed, np.uint8))
        self._uniforms[name] = packed, self.gpu.submissions
        return buffer

    def run(
        self,
        kernel: str,
        groups: int | tuple[int, int, int],
        share: float = 1.0,
        **buffers: Buffer,
    ) -> None:
        """``Gpu.run`` for buffers that are used again in the next step: their bind group is made
        once, which takes longer than to record a kernel.

        Args:
            share: The part of the bytes of the buffers that this dispatch uses, for the counts.
        """
        key = (kernel, *map(id, buffers.values()))
        if key not in self._groups:
            if len(self._groups) == MAX_GROUPS:
                self._groups.clear()
            self._groups[key] = self.gpu.bind(kernel, buffers)
        self.gpu.dispatch(kernel, groups, self._groups[key], share)
