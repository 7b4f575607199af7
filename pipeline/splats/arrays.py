"""The parameters of a scene's Gaussians as numpy arrays, for stages that do not render.

Writers of files read Gaussians in chunks (``GaussianSource``): what they compute, often in float64,
is never held for all Gaussians at once. Importing this module does not import torch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

#: Names of the arrays, in the order of files.
NAMES = ("means", "log_scales", "quats", "opacity_logits", "sh")
#: Number of Gaussians of a chunk.
CHUNK = 16384


def array_shapes(count: int, sh_degree: int) -> dict[str, tuple[int, ...]]:
    """The arrays' shapes by name."""
    width = (sh_degree + 1) ** 2
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, width, 3))
    return dict(zip(NAMES, shapes, strict=True))


class GaussianSource(Protocol):
    """Gaussians that can be read in chunks."""

    def __len__(self) -> int: ...

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""

    def chunks(self, *names: str) -> Iterator[list[Array]]:
        """The arrays of these names, up to ``CHUNK`` Gaussians at a time, in order."""


@dataclass
class GaussianArrays:
    """Parameters of N Gaussians, float32. They are those of ``gaussians.Gaussians``."""

    means: Array
    log_scales: Array
    quats: Array
    opacity_logits: Array
    sh: Array

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""
        return math.isqrt(self.sh.shape[1]) - 1

    def arrays(self) -> dict[str, Array]:
        """The arrays by name. They are not copied."""
        return {name: getattr(self, name) for name in NAMES}

    def chunks(self, *names: str) -> Iterator[list[Array]]:
        """See ``GaussianSource``. The arrays are not copied."""
        for start in range(0, len(self), CHUNK):
            yield [getattr(self, name)[start : start + CHUNK] for name in names]

    def scaled(self, factor: float) -> GaussianArrays:
        """The same Gaussians in a world whose coordinates are ``factor`` times as large; the
        arrays that do not change are shared."""
        if factor == 1:
            return self
        means, log_scales = np.empty_like(self.means), np.empty_like(self.log_scales)
        for start in range(0, len(self), CHUNK):
            rows = slice(start, start + CHUNK)
            means[rows] = self.means[rows].astype(np.float64) * factor
            log_scales[rows] = self.log_scales[rows].astype(np.float64) + math.log(factor)
        return replace(self, means=means, log_scales=log_scales)


@dataclass(frozen=True)
class GaussianRows:
    """Some Gaussians of ``source``, copied chunk by chunk when they are read.

    Attributes:
        rows: (M,) indices of the Gaussians, in their order.
        sh_degree: The degree of the spherical harmonics, at most that of ``source``.
    """

    source: GaussianArrays
    rows: NDArray[np.intp]
    sh_degree: int

    def __len__(self) -> int:
        return len(self.rows)

    def chunks(self, *names: str) -> Iterator[list[Array]]:
        """See ``GaussianSource``."""
        arrays = self.source.arrays()
        arrays["sh"] = arrays["sh"][:, : (self.sh_degree + 1) ** 2]
        for start in range(0, len(self), CHUNK):
            rows = self.rows[start : start + CHUNK]
            yield [arrays[name][rows] for name in names]


def collect(source: GaussianSource) -> GaussianArrays:
    """All Gaussians of a source, in memory."""
    shapes = array_shapes(len(source), source.sh_degree)
    arrays = {name: np.empty(shape, np.float32) for name, shape in shapes.items()}
    start = 0
    for chunk in source.chunks(*NAMES):
        for array, values in zip(arrays.values(), chunk, strict=True):
            array[start : start + len(values)] = values
        start += len(chunk[0])
    return GaussianArrays(**arrays)


def joined(parts: Sequence[GaussianArrays]) -> GaussianArrays:
    """The Gaussians of all parts, in their order."""
    arrays = [part.arrays() for part in parts]
    return GaussianArrays(**{name: np.concatenate([a[name] for a in arrays]) for name in NAMES})
