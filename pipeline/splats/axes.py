"""Gaussians in the axes of other programs.

The world is right-handed: for a camera at the identity, x points right, y down and z forward, as in
COLMAP and in 3DGS's PLY files. Other frames are named by the directions of their axes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.splats.arrays import Array, GaussianSource

#: The factors between coordinates in the world and in another frame.
Signs = tuple[int, int, int]
#: Right, up, back: SPZ, OpenGL and three.js.
RUB: Signs = (1, -1, -1)
#: Left, up, forward: glTF.
LUF: Signs = (-1, -1, 1)


@dataclass(frozen=True)
class Flipped:
    """Gaussians whose coordinates are multiplied by ``signs``, chunk by chunk.

    The axes of each Gaussian are flipped together with the world's. This does not change its
    ellipsoid, and no value changes except in sign: flipping twice restores every bit.
    """

    source: GaussianSource
    signs: Signs

    def __len__(self) -> int:
        return len(self.source)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""
        return self.source.sh_degree

    def chunks(self, *names: str) -> Iterator[list[Array]]:
        """See ``arrays.GaussianSource``."""
        for chunk in self.source.chunks(*names):
            yield list(flip(dict(zip(names, chunk, strict=True)), self.signs).values())


def flip(arrays: Mapping[str, NDArray[Any]], signs: Signs) -> dict[str, NDArray[Any]]:
    """Arrays of Gaussians by name (``arrays.NAMES``), in the same order, with coordinates
    multiplied by ``signs``; see ``Flipped``."""
    x, y, z = signs
    factors = {
        "means": np.array(signs, np.float32),
        "quats": np.array([1, y * z, x * z, x * y], np.float32),
    }
    if "sh" in arrays:
        factors["sh"] = _sh_signs(signs, arrays["sh"].shape[1])
    return {name: a * factors[name] if name in factors else a for name, a in arrays.items()}


def _sh_signs(signs: Signs, count: int) -> Array:
    """(count, 1) factors of the real spherical harmonics. A harmonic of degree l and order m is odd
    in y if m < 0, in z if l - m is odd, and in x if either m < 0 or m is odd."""
    x, y, z = signs
    found = np.ones((count, 1), np.float32)
    for k in range(count):
        degree = math.isqrt(k)
        m = k - degree * degree - degree
        odd = (x, (m < 0) != (m % 2 == 1)), (y, m < 0), (z, (degree - m) % 2 == 1)
        found[k] = math.prod(sign for sign, is_odd in odd if is_odd)
    return found
