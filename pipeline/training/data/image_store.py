"""Storage for training images: in memory, or in a temporary file when they do not fit."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from threading import Lock
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.runtime.memory import release_free_memory

# Freed memory is returned to the system after so many images: those of a block differ in size, and
# the heap would grow to several times the memory in use.
IMAGES_PER_RELEASE = 8

Planes = tuple[Tensor | None, ...]
"""The tensors of one image, of 8 bits or bool; None for those that it does not have."""


class ImageStore(Protocol):
    """Holds images. Any thread may call its methods."""

    def add(self, planes: Planes) -> Callable[[], Planes]:
        """Store the planes; the returned function reads them back, any number of times."""


class MemoryStore:
    """Holds images in memory."""

    def add(self, planes: Planes) -> Callable[[], Planes]:
        return lambda: planes


class DiskStore:
    """Holds images in an anonymous temporary file, which disappears with the process.

    The system's page cache holds as much of it as fits into free memory.

    Raises:
        OSError: The disk is full or not writable.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 (open as long as the store)
        self._end, self._images, self._lock = 0, 0, Lock()

    def add(self, planes: Planes) -> Callable[[], Planes]:
        self._count()
        readers = [None if plane is None else self._write(plane) for plane in planes]

        def read() -> Planes:
            self._count()
            return tuple(None if read is None else read() for read in readers)

        return read

    def _count(self) -> None:
        with self._lock:
            self._images += 1
            due = self._images % IMAGES_PER_RELEASE == 0
        if due:
            release_free_memory()

    def _write(self, plane: Tensor) -> Callable[[], Tensor]:
        array = plane.contiguous().numpy()
        with self._lock:
            begin = self._end
            self._end += array.nbytes
        data, done = _bytes(array), 0
        while done < len(data):
            done += os.pwrite(self._file.fileno(), data[done:], begin + done)
        shape, dtype = array.shape, array.dtype

        def read() -> Tensor:
            found = np.empty(shape, dtype)
            into, done = _bytes(found), 0
            while done < len(into):
                got = os.preadv(self._file.fileno(), [into[done:]], begin + done)
                if not got:
                    raise OSError("the temporary file of training images was truncated")
                done += got
            return torch.from_numpy(found)

        return read


def _bytes(array: NDArray[Any]) -> memoryview:
    return array.reshape(-1).view(np.uint8).data
