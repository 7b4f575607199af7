"""Where pictures wait for their turn: in memory, or in a file where that is too small."""

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

Planes = tuple[Tensor | None, ...]
"""The tensors of one picture, uint8 or bool; None where it has none of a kind."""


class Shelf(Protocol):
    def put(self, planes: Planes) -> Callable[[], Planes]:
        """Keep the planes; what is returned gives them back, bit for bit, as often as it is called.
        Any thread may call either."""


class MemoryShelf:
    """In memory, where they cost nothing to get."""

    def put(self, planes: Planes) -> Callable[[], Planes]:
        return lambda: planes


class DiskShelf:
    """In a file without a name, in the folder for temporary files: gone with the process, however
    that ends. The system keeps in spare memory what of it there is room for.

    Raises:
        OSError: the disk is full, or cannot be written to.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 (open for as long as the shelf is)
        self._end, self._lock = 0, Lock()

    def put(self, planes: Planes) -> Callable[[], Planes]:
        places = [None if plane is None else self._write(plane) for plane in planes]
        return lambda: tuple(None if place is None else place() for place in places)

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
                    raise OSError("a temporary file of pictures has been cut short")
                done += got
            return torch.from_numpy(found)

        return read


def _bytes(array: NDArray[Any]) -> memoryview:
    return array.reshape(-1).view(np.uint8).data
