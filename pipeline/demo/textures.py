"""Solid textures from sums of plane waves, with detail in a given range of wavelengths.

A sum of waves of random direction and phase is a band-limited Gaussian random field: it has blobs
at all scales for SIFT, and no aliasing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

BANDS = 6
WAVES_PER_BAND = 8
# The contrast. Larger values saturate more of the texture at the ends of its colour range.
STEEPNESS = 1.3


@dataclass(frozen=True)
class Material:
    """The colours of a surface in linear light.

    Attributes:
        base, tint_a, tint_b: RGB; the colour is base + a tint_a + b tint_b with a and b in (-1, 1).
        finest, coarsest: The shortest and longest wavelength of the texture in world units.
        seed: The seed of the pattern.
        gloss: The reflectance at normal incidence; 0 is a matte surface.
    """

    base: tuple[float, float, float]
    tint_a: tuple[float, float, float]
    tint_b: tuple[float, float, float]
    finest: float
    coarsest: float
    seed: int
    gloss: float = 0.0

    def albedo(self, point: Floats, blur: Floats) -> Floats:
        """(3, N) linear RGB at (3, N) points, blurred by a Gaussian of (N,) sigma, world unit."""
        a = self._field(point, blur, 0)
        b = self._field(point, blur, 1)
        base, tint_a, tint_b = (
            np.array(v, np.float32)[:, None] for v in (self.base, self.tint_a, self.tint_b)
        )
        return np.clip(base + tint_a * a + tint_b * b, 0.01, 0.95)

    def _field(self, point: Floats, blur: Floats, which: int) -> Floats:
        total = np.zeros(point.shape[1], np.float32)
        variance = 0.0
        for wavelength, directions, phases in _waves(self, which):
            # Amplitudes grow slowly with the wavelength, as in natural images.
            amplitude = (wavelength / self.coarsest) ** 0.3
            variance += amplitude**2 * WAVES_PER_BAND / 2
            waves = directions[0] * point[0]
            waves += directions[1] * point[1]
            waves += directions[2] * point[2]
            waves += phases
            band = np.zeros_like(total)
            for wave in np.cos(waves, out=waves):
                band += wave
            # A Gaussian blur of sigma s leaves exp(-2 pi^2 s^2 / wavelength^2) of a wave.
            fade = np.exp(np.float32(-2 * np.pi**2 / wavelength**2) * blur * blur)
            total += np.float32(amplitude) * fade * band
        return np.tanh(np.float32(STEEPNESS / np.sqrt(variance)) * total)


@cache
def _waves(material: Material, which: int) -> list[tuple[float, Floats, Floats]]:
    """Each band's wavelength, (3, WAVES_PER_BAND, 1) wave vectors, (WAVES_PER_BAND, 1) phases."""
    rng = np.random.default_rng([material.seed, which])
    bands = []
    for wavelength in np.geomspace(material.finest, material.coarsest, BANDS):
        directions = rng.normal(size=(WAVES_PER_BAND, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        phases = rng.uniform(0, 2 * np.pi, (WAVES_PER_BAND, 1)).astype(np.float32)
        vectors = (directions * 2 * np.pi / wavelength).astype(np.float32).T[:, :, None]
        bands.append((float(wavelength), np.ascontiguousarray(vectors), phases))
    return bands
