"""What readers of point clouds return."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.errors import UserError

Chunks = Iterator["Chunk"]
# Points that are in memory at a time while a file is read.
CHUNK_POINTS = 500_000
FIX = "export the cloud again, or set init.points_file: none"


class Chunk(NamedTuple):
    """Consecutive points of a file.

    Attributes:
        xyz: The (N, 3) float64 positions as stored, which may be not finite.
        colour: The (N, 3) float32 red, green and blue, or None.
        full: The value of full intensity, None if the format does not define it: then the values
            of the whole file decide.
    """

    xyz: NDArray[np.float64]
    colour: NDArray[np.float32] | None = None
    full: float | None = None


@dataclass(frozen=True)
class PointCloud:
    """A point cloud, subsampled.

    Attributes:
        xyz: The (N, 3) finite float64 positions in the file's coordinates.
        rgb: The (N, 3) uint8 colours, black where there is none.
        coloured: Whether each point has a colour, (N,) bool.
        num_read: The number of points in the files.
        num_invalid: The number of points whose coordinates are not finite.
    """

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    coloured: NDArray[np.bool_]
    num_read: int
    num_invalid: int

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def text(self) -> str:
        """How many points were read and kept."""
        invalid = f" ({self.num_invalid:,} are not finite)" if self.num_invalid else ""
        kept = f", one a voxel: {len(self):,}" if len(self) < self.num_read else ""
        return f"{self.num_read:,} points read{invalid}{kept}"


def damaged(path: Path, what: str) -> UserError:
    """The error for a file that is not a point cloud of its format."""
    return UserError(what, file=path, fix=FIX)


def stacked(columns: list[NDArray], dtype: type) -> NDArray:
    """(N, 3) array of three columns."""
    return np.stack([np.asarray(column, dtype) for column in columns], axis=1)
