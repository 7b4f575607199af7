"""Houses of the town, each different from all others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.town.finishes import Colour, Finish
from benchmarks.town.solids import UP, Frame, Prism, Solid, box, prism

Array = NDArray[np.float64]

WALLS: tuple[Colour, ...] = (
    *((0.66, 0.60, 0.46), (0.62, 0.36, 0.24), (0.40, 0.50, 0.56), (0.68, 0.66, 0.62)),
    *((0.36, 0.13, 0.08), (0.46, 0.36, 0.22), (0.58, 0.58, 0.55), (0.44, 0.54, 0.40)),
)
ROOFS: tuple[Colour, ...] = ((0.40, 0.13, 0.07), (0.22, 0.10, 0.07), (0.15, 0.16, 0.18))
FLAT_ROOF: Colour = (0.30, 0.29, 0.28)
WOOD: Colour = (0.26, 0.17, 0.10)
OVERHANG = 0.4
ROOF_THICKNESS = 0.16


@dataclass(frozen=True)
class Plot:
    """The place where a house stands.

    Attributes:
        x, y: The middle, metres.
        width, depth: The extent along the street, and across it.
        front: The side of the street: +1 if it is at smaller y, -1 if it is at larger y.
        yaw: The direction, radians.
    """

    x: float
    y: float
    width: float
    depth: float
    front: float
    yaw: float


def pick(rng: np.random.Generator, choices: tuple[Colour, ...], spread: float = 0.15) -> Colour:
    """One of the colours, varied in brightness and a little in tint."""
    base = np.array(choices[rng.integers(len(choices))])
    varied = np.clip(base * rng.uniform(1 - spread, 1 + spread) * rng.normal(1, 0.05, 3), 0.02, 0.8)
    return float(varied[0]), float(varied[1]), float(varied[2])


def fresh(rng: np.random.Generator) -> int:
    """The seed of another texture."""
    return int(rng.integers(2**62))


def house(rng: np.random.Generator, plot: Plot) -> list[Solid]:
    """A house with a gable or a flat roof, and what is built onto it."""
    flat = rng.random() < 0.22
    storeys = int(rng.choice([1, 2, 3], p=[0.3, 0.6, 0.1] if not flat else [0.1, 0.6, 0.3]))
    colour, eaves = pick(rng, WALLS), 2.8 * storeys + float(rng.uniform(0.2, 0.6))
    solids = (_flat if flat else _gabled)(rng, plot, colour, eaves)
    if rng.random() < 0.5:
        solids.append(_annex(rng, plot, colour))
    return solids


def faces(
    rng: np.random.Generator, colour: Colour, level: Colour | None = None
) -> Callable[[Array], Finish]:
    """The finish of a solid's faces by their normals, each with a texture of its own. ``level`` is
    the colour of the faces that look up or down; None is ``colour``."""
    return lambda normal: Finish(
        fresh(rng), level if level is not None and abs(normal[2]) > 0.2 else colour
    )


def axes(yaw: float) -> tuple[Array, Array]:
    """The horizontal unit vectors along and across a house."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([c, s, 0.0]), np.array([-s, c, 0.0])


def _flat(rng: np.random.Generator, plot: Plot, colour: Colour, eaves: float) -> list[Solid]:
    size = (plot.width, plot.depth, eaves + 0.35)
    solids: list[Solid] = [
        box((plot.x, plot.y), size, 0.0, plot.yaw, faces(rng, colour, FLAT_ROOF))
    ]
    along, across = axes(plot.yaw)
    middle = np.array([plot.x, plot.y, 0.0]) + rng.uniform(-2, 2) * along + across
    hut = (float(rng.uniform(1.6, 2.6)), float(rng.uniform(1.6, 2.4)), float(rng.uniform(0.8, 2.0)))
    finish = faces(rng, colour, FLAT_ROOF)
    solids.append(box((middle[0], middle[1]), hut, size[2], plot.yaw, finish))
    return solids


def _gabled(rng: np.random.Generator, plot: Plot, colour: Colour, eaves: float) -> list[Solid]:
    along, across = axes(plot.yaw)
    towards_street = rng.random() < 0.4  # the gable
    ridge = across if towards_street else along
    length, span = (plot.depth, plot.width) if towards_street else (plot.width, plot.depth)
    side = np.cross(UP, ridge)
    rise = span / 2 * float(rng.uniform(0.6, 1.0))
    half = span / 2
    wall, roof = faces(rng, colour, WOOD), faces(rng, WOOD, pick(rng, ROOFS))
    middle = np.array([plot.x, plot.y, 0.0])
    body = [(-half, 0.0), (half, 0.0), (half, eaves), (0.0, eaves + rise), (-half, eaves)]
    solids: list[Solid] = [
        prism(body, length, Frame(middle - length / 2 * ridge, side, UP, ridge), wall)
    ]
    slope = rise / half
    edge = half + OVERHANG
    for sign in (-1, 1):
        low = (sign * edge, eaves - slope * OVERHANG)
        slab = [(0.0, eaves + rise), low, (low[0], low[1] + ROOF_THICKNESS)]
        slab.append((0.0, eaves + rise + ROOF_THICKNESS))
        start = middle - (length / 2 + OVERHANG) * ridge
        solids.append(prism(slab, length + 2 * OVERHANG, Frame(start, side, UP, ridge), roof))
    solids.append(_chimney(rng, middle, ridge, side, length, half, eaves + rise))
    return solids


def _chimney(
    rng: np.random.Generator,
    middle: Array,
    ridge: Array,
    side: Array,
    length: float,
    half: float,
    top: float,
) -> Prism:
    at = middle + rng.uniform(-0.35, 0.35) * length * ridge + rng.uniform(-0.4, 0.4) * half * side
    size = (float(rng.uniform(0.5, 0.9)), 0.55, 2.4)
    yaw = float(np.arctan2(ridge[1], ridge[0]))
    return box(
        (at[0], at[1]), size, top - 1.6, yaw, faces(rng, pick(rng, WALLS), (0.08, 0.07, 0.07))
    )


def _annex(rng: np.random.Generator, plot: Plot, colour: Colour) -> Prism:
    """A garage or shed at the back, against the house."""
    along, across = axes(plot.yaw)
    width, depth = float(rng.uniform(2.6, 4.0)), float(rng.uniform(2.4, 3.5))
    shift = rng.uniform(-0.5, 0.5) * (plot.width - width)
    at = np.array([plot.x, plot.y, 0.0]) + shift * along
    at = at + plot.front * (plot.depth + depth) / 2 * across
    size = (width, depth, float(rng.uniform(2.3, 2.9)))
    finish = faces(rng, pick(rng, (WOOD, colour)), FLAT_ROOF)
    return box((at[0], at[1]), size, 0.0, plot.yaw, finish)
