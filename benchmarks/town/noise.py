"""Random fields for the town's textures."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

TILE = 1024  # side of the periodic tile, texels
TILE_SEED = 20
# The standard deviation of the tile's channels, of 127 steps on either side of the mean.
TILE_SIGMA = 40.0


def fractal(
    rng: np.random.Generator, height: int, width: int, finest: float, coarsest: float
) -> Floats:
    """A sum of octaves of smooth noise, (height, width), of about zero mean and unit deviation.
    ``finest`` and ``coarsest`` bound the distances between the noise's nodes, texels."""
    total = np.zeros((height, width), np.float32)
    variance, step = 0.0, coarsest
    while step >= finest:
        weight = (step / coarsest) ** 0.35
        rows, columns = int(height / step) + 3, int(width / step) + 3
        nodes = rng.standard_normal((rows, columns), dtype=np.float32)
        if step > 1:
            # A random crop shifts the phase: the nodes of all octaves must not coincide.
            large = cv2.resize(
                nodes,
                (int(columns * step), int(rows * step)),
                interpolation=cv2.INTER_CUBIC,
            )
            x, y = rng.integers(0, max(1, int(step)), 2)
            nodes = np.asarray(large[y : y + height, x : x + width], np.float32)
        total += np.float32(weight) * nodes[:height, :width]
        variance += weight**2 * (0.5 if step > 1 else 1.0)
        step /= 2
    return total / np.float32(np.sqrt(max(variance, 1e-9)))


@cache
def periodic_tile() -> NDArray[np.uint8]:
    """Four independent periodic fields around 128, (TILE, TILE, 4), with a spectrum like that of
    natural surfaces; computed once per process."""
    rng = np.random.default_rng(TILE_SEED)
    frequency = np.hypot(np.fft.fftfreq(TILE)[:, None], np.fft.rfftfreq(TILE)[None])
    # Detail goes down to three texels, structure up to a twelfth of the tile: no repetition shows.
    band = (frequency > 12 / TILE) * np.exp(-((frequency * 2.5) ** 4))
    weight = band / np.maximum(frequency, 1 / TILE) ** 0.9
    fields = []
    for _ in range(4):
        spectrum = np.fft.rfft2(rng.standard_normal((TILE, TILE))) * weight
        field = np.fft.irfft2(spectrum, (TILE, TILE))
        fields.append(field / field.std())
    values = 128 + TILE_SIGMA * np.stack(fields, axis=-1)
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)
