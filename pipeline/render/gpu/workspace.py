"""Buffers by name that grow when they are too small."""

from __future__ import annotations

from pipeline.render.gpu.device import Buffer, Gpu

GROWTH = 1.25  # over what is needed, if a buffer is replaced by a larger one


class Workspace:
    """Buffers of one owner. Their contents are undefined when they are requested."""

    def __init__(self, gpu: Gpu):
        self.gpu = gpu
        self._buffers: dict[str, Buffer] = {}

    def get(self, name: str, size: int) -> Buffer:
        """The buffer of this name, with at least ``size`` bytes."""
        found = self._buffers.get(name)
        if found is None or found.size < size:
            grown = size if found is None else min(int(GROWTH * size), self.gpu.max_bytes)
            found = self._buffers[name] = self.gpu.empty(max(size, grown), what=name)
        return found
