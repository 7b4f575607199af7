"""The light of the demo scene: the reference light, and the lights of other times of a day.

A light adds a sun, which shines through the walls and the ceiling, to the lamps and the even light
of the room. All light is linear, sRGB primaries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Colour = tuple[float, float, float]

CLOUD_WAVES = 6
CLOUD_WAVELENGTHS = 1.2, 4.0  # Metres.
CLOUD_DEPTHS = 0.15, 0.45

# The lights between noon and dusk, at even times: the sun's elevation in degrees and its power, the
# light of the sky, and the power of the lamps as a share of the reference's.
ELEVATIONS = (65.0, 45.0, 22.0, 8.0)
SUNS = ((0.75, 0.73, 0.68), (0.70, 0.64, 0.52), (0.62, 0.42, 0.22), (0.10, 0.05, 0.03))
SKIES = ((0.40, 0.44, 0.50), (0.36, 0.40, 0.47), (0.26, 0.26, 0.34), (0.12, 0.15, 0.26))
LAMPS_ON = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.25, 0.18, 0.10), (0.80, 0.58, 0.34))
SUN_TURNS_DEGREES = 140.0


@dataclass(frozen=True)
class Clouds:
    """A smooth pattern that dims the light: a sum of plane waves.

    Attributes:
        depth: The share of the light that the darkest part of the pattern takes.
        vectors: The CLOUD_WAVES wave vectors, radians per metre.
        phases: The CLOUD_WAVES phases in radians.
    """

    depth: float
    vectors: tuple[Colour, ...]
    phases: tuple[float, ...]

    def share(self, point: Array) -> Array:
        """(N,) shares of the light that reach (3, N) points."""
        total = np.zeros(point.shape[1])
        for (x, y, z), phase in zip(self.vectors, self.phases, strict=True):
            total += np.cos(x * point[0] + y * point[1] + z * point[2] + phase)
        pattern = np.tanh(total / np.sqrt(len(self.phases) / 2))
        return np.asarray(1 - self.depth * (0.5 + 0.5 * pattern))


@dataclass(frozen=True)
class Light:
    """A light of the scene.

    Attributes:
        sky: RGB of the even light of the room.
        lamps: RGB of the power of each lamp.
        sun: RGB of the irradiance of a surface that faces the sun; None without a sun.
        towards_sun: The unit vector to the sun.
        clouds: The pattern by which all light is multiplied; None without one.
    """

    sky: Colour
    lamps: tuple[Colour, ...]
    sun: Colour | None = None
    towards_sun: Colour = (0.0, 0.0, 1.0)
    clouds: Clouds | None = None


REFERENCE_LAMPS = (0.75, 0.35)
REFERENCE_LIGHT = Light((0.5, 0.5, 0.5), tuple((power,) * 3 for power in REFERENCE_LAMPS))


def lights(count: int, seed: int) -> list[Light]:
    """The reference light and ``count`` - 1 others, from noon to dusk in order."""
    rng = np.random.default_rng([seed, 6])
    azimuth = rng.uniform(0, 360)
    found = [REFERENCE_LIGHT]
    for time in np.linspace(0, 1, max(count - 1, 0)):
        turned = azimuth + SUN_TURNS_DEGREES * time
        found.append(_light_at(float(time), np.radians(turned), _clouds(rng)))
    return found


def _light_at(time: float, azimuth: float, clouds: Clouds) -> Light:
    """The light at a time from 0 (noon) to 1 (dusk)."""
    elevation = np.radians(_between(ELEVATIONS, time))
    flat = np.cos(elevation)
    towards = flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)
    sun, sky, on = (
        tuple(_between([row[channel] for row in table], time) for channel in range(3))
        for table in (SUNS, SKIES, LAMPS_ON)
    )
    lamps = tuple((power * on[0], power * on[1], power * on[2]) for power in REFERENCE_LAMPS)
    x, y, z = (float(value) for value in towards)
    return Light((sky[0], sky[1], sky[2]), lamps, (sun[0], sun[1], sun[2]), (x, y, z), clouds)


def _between(values: tuple[float, ...] | list[float], time: float) -> float:
    return float(np.interp(time, np.linspace(0, 1, len(values)), values))


def _clouds(rng: np.random.Generator) -> Clouds:
    vectors = rng.normal(size=(CLOUD_WAVES, 3))
    vectors *= 2 * np.pi / np.linalg.norm(vectors, axis=1, keepdims=True)
    vectors /= np.geomspace(*CLOUD_WAVELENGTHS, CLOUD_WAVES)[:, None]
    return Clouds(
        depth=float(rng.uniform(*CLOUD_DEPTHS)),
        vectors=tuple((float(x), float(y), float(z)) for x, y, z in vectors),
        phases=tuple(float(phase) for phase in rng.uniform(0, 2 * np.pi, CLOUD_WAVES)),
    )
