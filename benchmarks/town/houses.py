"""Houses of the town, each different from all others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from benchmarks.town.finishes import Colour, Cover, Finish, Wall
from benchmarks.town.solids import UP, Frame, Prism, Solid, box, prism

Array = NDArray[np.float64]

WALL_COLOURS: dict[str, tuple[Colour, ...]] = {
    "plaster": (
        *((0.66, 0.60, 0.46), (0.62, 0.36, 0.24), (0.40, 0.50, 0.56), (0.68, 0.66, 0.62)),
        *((0.60, 0.50, 0.24), (0.44, 0.54, 0.40), (0.62, 0.44, 0.40)),
    ),
    "brick": ((0.36, 0.13, 0.08), (0.42, 0.22, 0.13), (0.46, 0.36, 0.22), (0.28, 0.13, 0.11)),
    "boards": ((0.58, 0.58, 0.55), (0.22, 0.08, 0.06), (0.16, 0.26, 0.32), (0.36, 0.42, 0.30)),
    "timber": ((0.70, 0.66, 0.55), (0.62, 0.52, 0.36), (0.68, 0.60, 0.58)),
    "stone": ((0.44, 0.41, 0.36), (0.50, 0.44, 0.32), (0.36, 0.36, 0.37)),
}
ROOF_COLOURS: dict[str, tuple[Colour, ...]] = {
    "tiles": ((0.40, 0.13, 0.07), (0.32, 0.15, 0.09), (0.22, 0.10, 0.07), (0.36, 0.24, 0.16)),
    "slates": ((0.12, 0.13, 0.15), (0.18, 0.18, 0.19), (0.15, 0.17, 0.15)),
}
ACCENTS: tuple[Colour, ...] = (
    *((0.10, 0.22, 0.12), (0.35, 0.06, 0.05), (0.07, 0.14, 0.32), (0.28, 0.16, 0.07)),
    *((0.05, 0.05, 0.06), (0.42, 0.30, 0.06), (0.08, 0.28, 0.30)),
)
WOOD: Colour = (0.26, 0.17, 0.10)
OVERHANG = 0.4
ROOF_THICKNESS = 0.16


@dataclass(frozen=True)
class Plot:
    """Where a house stands.

    Attributes:
        x, y: its middle, metres.
        width, depth: along the street, and across it.
        front: +1 where the street is at smaller y, -1 where it is at larger y.
        yaw: radians.
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


@dataclass(frozen=True)
class Look:
    """What the walls of a house share."""

    wall: Wall
    colour: Colour
    accent: Colour
    eaves: float
    shop: bool


def house(rng: np.random.Generator, plot: Plot) -> list[Solid]:
    """A house with a gable or a flat roof, and what is built onto it."""
    wall: Wall = get_args(Wall)[rng.choice(5, p=[0.34, 0.26, 0.14, 0.14, 0.12])]
    flat = rng.random() < 0.22
    storeys = int(rng.choice([1, 2, 3], p=[0.3, 0.6, 0.1] if not flat else [0.1, 0.6, 0.3]))
    look = Look(
        wall=wall,
        colour=pick(rng, WALL_COLOURS[wall]),
        accent=pick(rng, ACCENTS),
        eaves=2.8 * storeys + float(rng.uniform(0.2, 0.6)),
        shop=storeys > 1 and rng.random() < 0.2,
    )
    solids = _flat(rng, plot, look) if flat else _gabled(rng, plot, look)
    if rng.random() < 0.5:
        solids.append(_annex(rng, plot, look))
    return solids


def axes(yaw: float) -> tuple[Array, Array]:
    """Horizontal unit vectors along and across a house."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([c, s, 0.0]), np.array([-s, c, 0.0])


def _wall(rng: np.random.Generator, plot: Plot, look: Look, normal: Array) -> Finish:
    street = normal[1] * -plot.front > 0.9
    shop = look.shop and street
    return Finish(
        look.wall, fresh(rng), look.colour, look.accent, look.eaves, street and not shop, shop
    )


def _flat(rng: np.random.Generator, plot: Plot, look: Look) -> list[Solid]:
    cover = pick(rng, ((0.30, 0.29, 0.28), (0.38, 0.35, 0.30)))

    def finish(normal: Array) -> Finish:
        if abs(normal[2]) > 0.5:
            return Finish("gravel", fresh(rng), cover)
        return _wall(rng, plot, look, normal)

    size = (plot.width, plot.depth, look.eaves + 0.35)
    solids: list[Solid] = [box((plot.x, plot.y), size, 0.0, plot.yaw, finish)]
    along, across = axes(plot.yaw)
    middle = np.array([plot.x, plot.y, 0.0]) + rng.uniform(-2, 2) * along + across
    hut = (float(rng.uniform(1.6, 2.6)), float(rng.uniform(1.6, 2.4)), float(rng.uniform(0.8, 2.0)))

    def top(normal: Array) -> Finish:
        if abs(normal[2]) > 0.5:
            return Finish("gravel", fresh(rng), cover)
        return Finish(look.wall, fresh(rng), look.colour)

    solids.append(box((middle[0], middle[1]), hut, size[2], plot.yaw, top))
    return solids


def _gabled(rng: np.random.Generator, plot: Plot, look: Look) -> list[Solid]:
    along, across = axes(plot.yaw)
    towards_street = rng.random() < 0.4  # the gable
    ridge = across if towards_street else along
    length, span = (plot.depth, plot.width) if towards_street else (plot.width, plot.depth)
    side = np.cross(UP, ridge)
    rise = span / 2 * float(rng.uniform(0.6, 1.0))
    half, eaves = span / 2, look.eaves
    cover: Cover = "tiles" if rng.random() < 0.65 else "slates"
    colour = pick(rng, ROOF_COLOURS[cover])
    middle = np.array([plot.x, plot.y, 0.0])

    def wall(normal: Array) -> Finish:
        if abs(normal[2]) > 0.2:
            return Finish("wood", fresh(rng), WOOD)
        return _wall(rng, plot, look, normal)

    def roof(normal: Array) -> Finish:
        if normal[2] > 0.2:
            return Finish(cover, fresh(rng), colour)
        return Finish("wood", fresh(rng), WOOD)

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
    colour = pick(rng, WALL_COLOURS["brick"])
    size = (float(rng.uniform(0.5, 0.9)), 0.55, 2.4)
    yaw = float(np.arctan2(ridge[1], ridge[0]))

    def finish(normal: Array) -> Finish:
        dark = (0.08, 0.07, 0.07) if abs(normal[2]) > 0.5 else colour
        return Finish("brick" if abs(normal[2]) < 0.5 else "wood", fresh(rng), dark)

    return box((at[0], at[1]), size, top - 1.6, yaw, finish)


def _annex(rng: np.random.Generator, plot: Plot, look: Look) -> Prism:
    """A garage or shed at the back, against the house."""
    along, across = axes(plot.yaw)
    width, depth = float(rng.uniform(2.6, 4.0)), float(rng.uniform(2.4, 3.5))
    shift = rng.uniform(-0.5, 0.5) * (plot.width - width)
    at = np.array([plot.x, plot.y, 0.0]) + shift * along
    at = at + plot.front * (plot.depth + depth) / 2 * across
    colour, cover = pick(rng, (WOOD, look.colour)), pick(rng, ((0.3, 0.29, 0.28),))
    kind: Wall = "boards" if rng.random() < 0.5 else look.wall

    def finish(normal: Array) -> Finish:
        if abs(normal[2]) > 0.5:
            return Finish("gravel", fresh(rng), cover)
        return Finish(kind, fresh(rng), colour, look.accent)

    return box((at[0], at[1]), (width, depth, float(rng.uniform(2.3, 2.9))), 0.0, plot.yaw, finish)
