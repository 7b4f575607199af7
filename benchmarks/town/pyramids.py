"""Image pyramids in one picture, and trilinear sampling of them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

# The longest run of samples that cv2.remap takes.
MAX_SAMPLES = 32_000
SMALLEST_LEVEL = 2  # texels


@dataclass(frozen=True)
class Pyramid:
    """An image with its reductions by 2, 4, 8, ..., packed into one picture.

    Attributes:
        packed: The levels in one picture, (H, W, K) uint8.
        left, top: The corner of each level in ``packed``, (L,).
        width, height: The size of each level, (L,).
        periodic: Whether the image repeats. If so, each level ends with a copy of its first
            column and row.
    """

    packed: NDArray[np.uint8]
    left: Floats
    top: Floats
    width: Floats
    height: Floats
    periodic: bool = False

    @property
    def num_bytes(self) -> int:
        return self.packed.nbytes

    def sample(self, x: Floats, y: Floats, level: Floats) -> Floats:
        """The (N, K) values at (N,) positions.

        Args:
            x, y: The texels of level 0 from the image's corner; clamped unless ``periodic``.
            level: The binary logarithm of the filter's width in texels.
        """
        level = np.clip(level, 0.0, np.float32(len(self.left) - 1.001))
        low = level.astype(np.intp)
        blend = (level - low)[:, None]
        first, second = self._at(x, y, low), self._at(x, y, low + 1)
        return np.asarray(first + blend * (second - first))

    def _at(self, x: Floats, y: Floats, level: NDArray[np.intp]) -> Floats:
        width, height = self.width[level], self.height[level]
        u, v = x * (width / self.width[0]), y * (height / self.height[0])
        u -= np.float32(0.5)
        v -= np.float32(0.5)
        if self.periodic:
            u -= np.floor(u / width) * width  # faster than the remainder
            v -= np.floor(v / height) * height
        else:
            np.clip(u, 0, width - 1, out=u)
            np.clip(v, 0, height - 1, out=v)
        u += self.left[level]
        v += self.top[level]
        shape = (len(x), self.packed.shape[2])
        out = np.empty(shape, np.float32)
        for start in range(0, len(x), MAX_SAMPLES):
            part = slice(start, start + MAX_SAMPLES)
            found = cv2.remap(self.packed, u[None, part], v[None, part], cv2.INTER_LINEAR)
            out[part] = found.reshape(-1, shape[1])
        return out


def pyramid(image: Floats, periodic: bool = False) -> Pyramid:
    """The pyramid of an (H, W, K) image with values in [0, 255]; a level is the mean of 2x2 texels.

    The sides of a periodic image are powers of 2.
    """
    levels = [image]
    while min(levels[-1].shape[:2]) >= 2 * SMALLEST_LEVEL:
        last = levels[-1]
        size = ((last.shape[1] + 1) // 2, (last.shape[0] + 1) // 2)
        levels.append(
            np.asarray(cv2.resize(last, size, interpolation=cv2.INTER_AREA), np.float32).reshape(
                size[1], size[0], -1
            )
        )
    if len(levels) == 1:
        levels.append(levels[0])
    more = 1 if periodic else 0
    sizes = np.array([level.shape[:2] for level in levels])
    packed = np.zeros(
        (
            max(sizes[0, 0], int((sizes[1:, 0] + more).sum())) + more,
            int(sizes[0, 1] + sizes[1, 1]) + 2 * more,
            image.shape[2],
        ),
        np.uint8,
    )
    left = np.array([0] + [sizes[0, 1] + more] * (len(levels) - 1))
    top = np.concatenate([[0, 0], np.cumsum(sizes[1:-1, 0] + more)])
    for level, x, y in zip(levels, left, top, strict=True):
        stored = np.pad(level, ((0, more), (0, more), (0, 0)), mode="wrap") if more else level
        packed[y : y + stored.shape[0], x : x + stored.shape[1]] = np.rint(np.clip(stored, 0, 255))
    return Pyramid(
        packed,
        left.astype(np.float32),
        top.astype(np.float32),
        sizes[:, 1].astype(np.float32),
        sizes[:, 0].astype(np.float32),
        periodic,
    )
