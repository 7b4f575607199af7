"""Trees, borders of plots, cars and what stands in the streets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.town.finishes import Colour
from benchmarks.town.houses import axes, faces, fresh, pick
from benchmarks.town.solids import UP, Ellipsoid, Frame, Solid, box, prism

Array = NDArray[np.float64]

GREENERY: tuple[Colour, ...] = ((0.07, 0.15, 0.04), (0.10, 0.17, 0.04), (0.05, 0.11, 0.05))
BORDERS: tuple[Colour, ...] = (
    *GREENERY,
    *((0.32, 0.22, 0.13), (0.55, 0.55, 0.52), (0.42, 0.40, 0.36), (0.34, 0.14, 0.09)),
)
PAINTS: tuple[Colour, ...] = (
    *((0.45, 0.04, 0.04), (0.05, 0.10, 0.28), (0.55, 0.55, 0.56), (0.04, 0.04, 0.05)),
    *((0.35, 0.33, 0.28), (0.08, 0.22, 0.14), (0.50, 0.34, 0.05), (0.24, 0.28, 0.33)),
)


def border(
    rng: np.random.Generator,
    centre: tuple[float, float],
    size: tuple[float, float],
    tall: bool = False,
) -> Solid:
    """A hedge, fence or low wall between plots."""
    height = float(rng.uniform(1.4, 1.8) if tall else rng.uniform(0.6, 1.1))
    return box(centre, (*size, height), 0.0, 0.0, faces(rng, pick(rng, BORDERS)))


def tree(rng: np.random.Generator, at: tuple[float, float], scale: float) -> list[Solid]:
    height = float(rng.uniform(2.0, 3.2)) * scale
    colour = pick(rng, GREENERY, 0.3)
    trunk = (0.26, 0.26, height + 0.6)
    bark = faces(rng, (0.16, 0.12, 0.09))
    solids: list[Solid] = [box(at, trunk, 0.0, float(rng.uniform(0, 1.5)), bark)]
    for number in range(int(rng.integers(6, 10))):
        radius = float(rng.uniform(0.5, 1.15)) * scale
        angle, out = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 1.1) * scale * (number > 0)
        centre = (
            at[0] + float(out * np.cos(angle)),
            at[1] + float(out * np.sin(angle)),
            height + radius * 0.5 + float(rng.uniform(0, 1.9)) * scale,
        )
        wide, high = float(rng.uniform(0.8, 1.1)), float(rng.uniform(0.7, 0.95))
        radii = (radius, radius * wide, radius * high)
        solids.append(Ellipsoid(centre, radii, pick(rng, (colour,), 0.15), fresh(rng)))
    return solids


def shrub(rng: np.random.Generator, at: tuple[float, float], radius: float) -> Solid:
    radii = (radius, radius * float(rng.uniform(0.8, 1.2)), radius * float(rng.uniform(0.8, 1.3)))
    return Ellipsoid((*at, radius * 0.5), radii, pick(rng, GREENERY, 0.3), fresh(rng))


def car(rng: np.random.Generator, at: tuple[float, float]) -> list[Solid]:
    """A car, parked along the street."""
    colour = pick(rng, PAINTS)
    length, half = float(rng.uniform(3.8, 4.5)) / 2, 0.85
    along, across = axes(float(rng.normal(0, 0.02) + np.pi * rng.integers(2)))
    roof = float(rng.uniform(1.38, 1.6))
    centre = np.array([*at, 0.0])
    low = [(-length, 0.22), (length, 0.22), (length, 0.68), (length - 0.3, 0.82)]
    low += [(-length + 0.1, 0.88), (-length, 0.8)]
    high = [(-length + 0.35, 0.8), (length - 1.0, 0.8), (length - 1.75, roof)]
    high.append((-length + 0.75, roof))
    # In a right-handed frame with the profile along and up, the third axis points to the right.
    first, wide = centre + half * across, 2 * half
    second = centre + (half - 0.1) * across
    return [
        prism(low, wide, Frame(first, along, UP, -across), faces(rng, colour)),
        prism(
            high,
            wide - 0.2,
            Frame(second, along, UP, -across),
            faces(rng, (0.05, 0.06, 0.07), colour),
        ),
    ]


def lamp(rng: np.random.Generator, x: float, y: float) -> list[Solid]:
    """A lamp post with a sign."""
    metal = faces(rng, (0.10, 0.12, 0.12))
    return [
        box((x, y), (0.12, 0.12, 4.6), 0.0, 0.0, metal),
        box((x, y), (0.5, 0.3, 0.25), 4.6, 0.0, metal),
        box((x, y), (0.5, 0.14, 0.4), 2.3, float(rng.normal(0, 0.2)), faces(rng, (0.7, 0.7, 0.66))),
    ]


def monument(rng: np.random.Generator, at: tuple[float, float]) -> list[Solid]:
    stone, bronze = pick(rng, ((0.46, 0.44, 0.40),)), pick(rng, ((0.2, 0.3, 0.26),))
    return [
        box(at, (1.8, 1.8, 0.8), 0.0, 0.3, faces(rng, stone)),
        box(at, (0.8, 0.8, 2.2), 0.8, 0.3, faces(rng, stone)),
        Ellipsoid((*at, 3.5), (0.5, 0.5, 0.7), bronze, fresh(rng)),
    ]
