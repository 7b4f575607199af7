"""The union of trained blocks: each Gaussian is in exactly one. Importing this module does not
import torch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.io.npz import read_gaussian_arrays
from pipeline.scene.blocks import Partition
from pipeline.splats.arrays import Array, GaussianRows


class Union:
    """All Gaussians of the blocks, of the highest SH degree among them.

    A block comes without the Gaussians that its training left outside of its box: in the margin,
    which other blocks train as well. Blocks are read when they are needed, one at a time
    (``arrays.GaussianSource``).

    Args:
        files: The files of the blocks' Gaussians, by number.

    Raises:
        UserError: A file is missing, damaged, or not one of Gaussians.
    """

    def __init__(self, files: Sequence[Path], partition: Partition) -> None:
        self._files = files
        found = [_inside(file, partition, number) for number, file in enumerate(files, 1)]
        self._rows = [rows for rows, _ in found]
        self.sh_degree = max(degree for _, degree in found)

    def __len__(self) -> int:
        return sum(map(len, self._rows))

    def chunks(self, *names: str) -> Iterator[list[Array]]:
        """See ``arrays.GaussianSource``."""
        for file, rows in zip(self._files, self._rows, strict=True):
            yield from self._block(file, rows, names)

    def _block(
        self, file: Path, rows: NDArray[np.intp], names: Sequence[str]
    ) -> Iterator[list[Array]]:
        trained = read_gaussian_arrays(file)
        missing = (self.sh_degree + 1) ** 2 - trained.sh.shape[1]
        for chunk in GaussianRows(trained, rows, trained.sh_degree).chunks(*names):
            yield [
                np.pad(values, ((0, 0), (0, missing), (0, 0))) if name == "sh" else values
                for name, values in zip(names, chunk, strict=True)
            ]


def _inside(file: Path, partition: Partition, number: int) -> tuple[NDArray[np.intp], int]:
    """The rows of a block's Gaussians inside of its box, and their SH degree."""
    trained = read_gaussian_arrays(file)
    return np.flatnonzero(partition.box(number).contains(trained.means)), trained.sh_degree
