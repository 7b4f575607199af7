"""The plan of the town: cells of one stretch of street each, in a spiral around the first.

A cell is the same whatever the size of the town: its random numbers come from the seed and its
place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.demo.town.finishes import Colour, Finish, Plain, Wall
from pipeline.demo.town.houses import Plot, axes, fresh, house, pick
from pipeline.demo.town.solids import UP, Ellipsoid, Frame, Solid, box, prism

Array = NDArray[np.float64]
Cell = tuple[int, int]

# A cell is this long and wide, metres. Its street runs along x through its middle, a cross street
# along y at its lower end.
LENGTH, WIDTH = 48.0, 44.0
ROAD = 2.9  # half the width of the roadway
STREET = 5.2  # half the width with the pavements
PLOTS = 3  # on each side
GREENERY: tuple[Colour, ...] = ((0.07, 0.15, 0.04), (0.10, 0.17, 0.04), (0.05, 0.11, 0.05))
BORDERS: tuple[Wall | Plain, ...] = ("hedge", "fence", "stone", "brick")
PAINTS: tuple[Colour, ...] = (
    *((0.45, 0.04, 0.04), (0.05, 0.10, 0.28), (0.55, 0.55, 0.56), (0.04, 0.04, 0.05)),
    *((0.35, 0.33, 0.28), (0.08, 0.22, 0.14), (0.50, 0.34, 0.05), (0.24, 0.28, 0.33)),
)


@dataclass(frozen=True)
class Town:
    """The solids of a town and its paved ground.

    Attributes:
        cells: in the order of the photographs.
        solids: houses, trees, cars and all else that stands on the ground.
        paved: (K, 2) corners of convex polygons: paths, drives and squares.
    """

    cells: tuple[Cell, ...]
    solids: tuple[Solid, ...]
    paved: tuple[Array, ...]


def spiral(count: int) -> tuple[Cell, ...]:
    """The first ``count`` cells of a square spiral; each is next to an earlier one."""
    cells, x, y = [(0, 0)], 0, 0
    step, run = np.array([1, 0]), 1
    while len(cells) < count:
        for _ in range(2):
            for _ in range(run):
                x, y = x + int(step[0]), y + int(step[1])
                cells.append((x, y))
            step = np.array([-step[1], step[0]])
        run += 1
    return tuple(cells[:count])


def build(cells: tuple[Cell, ...], seed: int) -> Town:
    """The town of some cells."""
    solids: list[Solid] = []
    paved: list[Array] = []
    for cell in cells:
        _fill(cell, seed, solids, paved)
    for cell in _around(cells):
        _outskirts(cell, seed, solids)
    return Town(cells, tuple(solids), tuple(paved))


def _around(cells: tuple[Cell, ...]) -> list[Cell]:
    """Cells that touch those of the town from outside."""
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return sorted({(x + i, y + j) for x, y in cells for i, j in steps} - set(cells))


def _outskirts(cell: Cell, seed: int, solids: list[Solid]) -> None:
    """Meadows with trees, hedges and a few houses."""
    rng = np.random.default_rng([seed, 13, cell[0] + 100_000, cell[1] + 100_000])
    x0, y0 = cell[0] * LENGTH + STREET, cell[1] * WIDTH - WIDTH / 2
    for row in range(2):
        for column in range(3):
            x = x0 + (column + float(rng.uniform(0.3, 0.7))) * (LENGTH - 2 * STREET) / 3
            y = y0 + (row + float(rng.uniform(0.35, 0.65))) * WIDTH / 2
            draw = rng.random()
            if draw < 0.3:
                size = (float(rng.uniform(7, 10)), float(rng.uniform(7, 9)))
                front, yaw = float(rng.choice([-1, 1])), float(rng.normal(0, 0.05))
                solids += house(rng, Plot(x, y, *size, front, yaw))
                continue
            if draw < 0.6:
                solids.append(_border(rng, (x, y - 3.5), (float(rng.uniform(4, 10)), 0.5), True))
            for _ in range(int(rng.integers(1, 5))):
                at = x + float(rng.uniform(-5, 5)), y + float(rng.uniform(-5, 5))
                solids += _tree(rng, at, float(rng.uniform(0.9, 1.7)))


def _fill(cell: Cell, seed: int, solids: list[Solid], paved: list[Array]) -> None:
    # Offsets: parts of a seed are not negative.
    rng = np.random.default_rng([seed, 11, cell[0] + 100_000, cell[1] + 100_000])
    x0, y0 = cell[0] * LENGTH, cell[1] * WIDTH
    pitch = (LENGTH - 2 * STREET - 0.6) / PLOTS
    green = int(rng.integers(2 * PLOTS))
    for number in range(2 * PLOTS):
        front = 1.0 if number < PLOTS else -1.0
        left = x0 + STREET + 0.3 + (number % PLOTS) * pitch
        if number == green:
            _park(rng, left, y0, pitch, front, solids, paved)
        else:
            _plot(rng, left, y0, pitch, front, solids, paved)
        if rng.random() < 0.55:
            at = left + float(rng.uniform(2.3, pitch - 2.3)), y0 + front * (ROAD - 1.0)
            solids += _car(rng, at)
    for side in (-1.0, 1.0):
        solids += _lamp(rng, x0 + STREET + 1 + float(rng.uniform(0, 30)), y0 + side * (ROAD + 0.3))


def _plot(
    rng: np.random.Generator,
    left: float,
    y0: float,
    pitch: float,
    front: float,
    solids: list[Solid],
    paved: list[Array],
) -> None:
    width, depth = float(rng.uniform(0.68, 0.88) * pitch), float(rng.uniform(7.0, 9.0))
    garden = float(rng.uniform(1.2, 3.4))
    x = left + pitch / 2 + float(rng.uniform(-0.5, 0.5)) * (pitch - width - 0.6)
    y = y0 + front * (STREET + garden + depth / 2)
    plot = Plot(x, y, width, depth, front, float(rng.normal(0, 0.02)))
    solids += house(rng, plot)
    gate = x + float(rng.uniform(-0.25, 0.25)) * width
    line, back = y0 + front * (STREET + 0.15), y0 + front * (WIDTH / 2 - 0.2)
    paved.append(_rectangle(gate, y0 + front * (STREET + garden / 2), 1.5, garden + 0.3))
    for a, b in ((left + 0.1, gate - 0.75), (gate + 0.75, left + pitch - 0.1)):
        if b - a > 0.6 and rng.random() < 0.8:
            solids.append(_border(rng, ((a + b) / 2, line), (b - a, 0.35)))
    solids.append(_border(rng, (left + pitch / 2, back), (pitch - 0.3, 0.3), tall=True))
    middle = (line + front * (garden + depth) + back) / 2
    length = abs(back - line) - garden - depth - 1.0
    solids.append(_border(rng, (left + 0.05, middle), (0.25, length), tall=True))
    paved.append(_rectangle(x, y + front * (depth / 2 + 1.5), width * 0.7, 3.0))
    for _ in range(int(rng.integers(1, 4))):
        at = left + float(rng.uniform(1.8, pitch - 1.8)), back - front * float(rng.uniform(2, 3.2))
        solids += _tree(rng, at, float(rng.uniform(0.7, 1.0)))
    for _ in range(int(rng.integers(2, 6))):
        side = float(rng.uniform(0.3, max(0.4, garden - 0.5)))
        at = left + float(rng.uniform(0.6, pitch - 0.6)), line + front * side
        solids.append(_shrub(rng, at, float(rng.uniform(0.25, 0.55))))


def _park(
    rng: np.random.Generator,
    left: float,
    y0: float,
    pitch: float,
    front: float,
    solids: list[Solid],
    paved: list[Array],
) -> None:
    """A small square: trees, benches, a kiosk and a monument on paved ground."""
    x, y = left + pitch / 2, y0 + front * (STREET + 7.0)
    paved.append(_rectangle(x, y0 + front * (STREET + 5.0), 2.0, 10.5))
    paved.append(_rectangle(x, y, 7.0, 5.5))
    base = (float(x), float(y + front * 0.5))
    stone = pick(rng, ((0.46, 0.44, 0.40),))

    def plain(_: Array) -> Finish:
        return Finish("stone", fresh(rng), stone)

    solids.append(box(base, (1.8, 1.8, 0.8), 0.0, 0.3, plain))
    solids.append(box(base, (0.8, 0.8, 2.2), 0.8, 0.3, plain))
    solids.append(
        Ellipsoid((*base, 3.5), (0.5, 0.5, 0.7), pick(rng, ((0.2, 0.3, 0.26),)), fresh(rng))
    )
    for sign in (-1, 1):
        for deep in (3.2, 13.0):
            at = x + sign * float(rng.uniform(3.6, 4.4)), y0 + front * (STREET + deep)
            solids += _tree(rng, at, float(rng.uniform(0.8, 1.1)))
        bench = (float(x + sign * 2.6), float(y + front * 1.2))
        solids.append(box(bench, (1.6, 0.5, 0.45), 0.0, 0.0, _wooden(rng, (0.3, 0.16, 0.07))))
    kiosk = (float(x + rng.uniform(-2, 2)), float(y0 + front * (STREET + 14.0)))
    accent = pick(rng, PAINTS)

    def sides(normal: Array) -> Finish:
        if abs(normal[2]) > 0.5:
            return Finish("gravel", fresh(rng), (0.3, 0.3, 0.3))
        return Finish("boards", fresh(rng), accent, accent, 2.6, True)

    solids.append(box(kiosk, (3.6, 2.6, 2.7), 0.0, float(rng.normal(0, 0.1)), sides))


def _rectangle(x: float, y: float, width: float, depth: float) -> Array:
    a, b = width / 2, depth / 2
    return np.array([[x - a, y - b], [x + a, y - b], [x + a, y + b], [x - a, y + b]])


def _wooden(rng: np.random.Generator, colour: Colour) -> Callable[[Array], Finish]:
    return lambda _: Finish("wood", fresh(rng), colour)


def _border(
    rng: np.random.Generator,
    centre: tuple[float, float],
    size: tuple[float, float],
    tall: bool = False,
) -> Solid:
    """A hedge, fence or low wall between plots."""
    kind = BORDERS[rng.choice(len(BORDERS), p=[0.4, 0.3, 0.15, 0.15])]
    height = float(rng.uniform(1.4, 1.8) if tall else rng.uniform(0.6, 1.1))
    colours: dict[str, tuple[Colour, ...]] = {
        "hedge": GREENERY,
        "fence": ((0.32, 0.22, 0.13), (0.55, 0.55, 0.52), (0.2, 0.24, 0.2)),
        "stone": ((0.42, 0.40, 0.36),),
        "brick": ((0.34, 0.14, 0.09),),
    }
    colour = pick(rng, colours[kind])
    return box(centre, (*size, height), 0.0, 0.0, lambda _: Finish(kind, fresh(rng), colour))


def _tree(rng: np.random.Generator, at: tuple[float, float], scale: float) -> list[Solid]:
    height = float(rng.uniform(2.0, 3.2)) * scale
    colour = pick(rng, GREENERY, 0.3)
    bark = (0.16, 0.12, 0.09)
    solids: list[Solid] = [
        box(
            at,
            (0.26, 0.26, height + 0.6),
            0.0,
            float(rng.uniform(0, 1.5)),
            lambda _: Finish("bark", fresh(rng), bark),
        )
    ]
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


def _shrub(rng: np.random.Generator, at: tuple[float, float], radius: float) -> Solid:
    radii = (radius, radius * float(rng.uniform(0.8, 1.2)), radius * float(rng.uniform(0.8, 1.3)))
    return Ellipsoid((*at, radius * 0.5), radii, pick(rng, GREENERY, 0.3), fresh(rng))


def _car(rng: np.random.Generator, at: tuple[float, float]) -> list[Solid]:
    """A car, parked along the street."""
    colour = pick(rng, PAINTS)
    length, half = float(rng.uniform(3.8, 4.5)) / 2, 0.85
    along, across = axes(float(rng.normal(0, 0.02) + np.pi * rng.integers(2)))
    roof = float(rng.uniform(1.38, 1.6))
    centre = np.array([*at, 0.0])

    def body(_: Array) -> Finish:
        return Finish("car", fresh(rng), colour)

    def cabin(normal: Array) -> Finish:
        return Finish("car" if abs(normal[2]) > 0.9 else "cabin", fresh(rng), colour)

    low = [(-length, 0.22), (length, 0.22), (length, 0.68), (length - 0.3, 0.82)]
    low += [(-length + 0.1, 0.88), (-length, 0.8)]
    high = [(-length + 0.35, 0.8), (length - 1.0, 0.8), (length - 1.75, roof)]
    high.append((-length + 0.75, roof))
    # In a right-handed frame with the profile along and up, the third axis points to the right.
    first, wide = centre + half * across, 2 * half
    second = centre + (half - 0.1) * across
    return [
        prism(low, wide, Frame(first, along, UP, -across), body),
        prism(high, wide - 0.2, Frame(second, along, UP, -across), cabin),
    ]


def _lamp(rng: np.random.Generator, x: float, y: float) -> list[Solid]:
    metal: Colour = (0.10, 0.12, 0.12)

    def plate(_: Array) -> Finish:
        return Finish("sign", fresh(rng), (0.7, 0.7, 0.66), (0.06, 0.12, 0.35))

    def post(_: Array) -> Finish:
        return Finish("metal", fresh(rng), metal)

    return [
        box((x, y), (0.12, 0.12, 4.6), 0.0, 0.0, post),
        box((x, y), (0.5, 0.3, 0.25), 4.6, 0.0, post),
        box((x, y), (0.5, 0.14, 0.4), 2.3, float(rng.normal(0, 0.2)), plate),
    ]
