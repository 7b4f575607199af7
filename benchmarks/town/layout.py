"""The plan of the town: cells of one stretch of street each, in a spiral around the first.

A cell is the same whatever the size of the town: its random numbers come from the seed and its
place. Cells around the town have meadows and a few houses.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.town.furniture import PAINTS, border, car, lamp, monument, shrub, tree
from benchmarks.town.houses import FLAT_ROOF, Plot, faces, house, pick
from benchmarks.town.solids import Solid, box

Array = NDArray[np.float64]
Cell = tuple[int, int]

# A cell is this long and wide, metres. Its street runs along x through its middle, a cross street
# along y at its lower end.
LENGTH, WIDTH = 48.0, 44.0
ROAD = 2.9  # half the width of the roadway
STREET = 5.2  # half the width with the pavements
PLOTS = 3  # on each side


@dataclass(frozen=True)
class Town:
    """The solids of a town and its paved ground.

    Attributes:
        cells: The cells, in the order of the photographs.
        solids: The houses, trees, cars and all else that stands on the ground.
        paved: The (K, 2) corners of convex polygons: paths, drives and squares.
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


@dataclass
class _Site:
    """What has been placed so far."""

    solids: list[Solid] = field(default_factory=list)
    paved: list[Array] = field(default_factory=list)


def build(cells: tuple[Cell, ...], seed: int) -> Town:
    """The town of some cells, and its outskirts."""
    site = _Site()
    for cell in cells:
        _fill(cell, seed, site)
    for cell in _around(cells):
        _outskirts(cell, seed, site)
    return Town(cells, tuple(site.solids), tuple(site.paved))


def _random(seed: int, part: int, cell: Cell) -> np.random.Generator:
    # Parts of a seed are not negative.
    return np.random.default_rng([seed, part, cell[0] + 100_000, cell[1] + 100_000])


def _around(cells: tuple[Cell, ...]) -> list[Cell]:
    """The cells that touch those of the town from outside."""
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return sorted({(x + i, y + j) for x, y in cells for i, j in steps} - set(cells))


def _outskirts(cell: Cell, seed: int, site: _Site) -> None:
    """Meadows with trees, hedges and a few houses."""
    rng = _random(seed, 13, cell)
    x0, y0 = cell[0] * LENGTH + STREET, cell[1] * WIDTH - WIDTH / 2
    for row in range(2):
        for column in range(3):
            x = x0 + (column + float(rng.uniform(0.3, 0.7))) * (LENGTH - 2 * STREET) / 3
            y = y0 + (row + float(rng.uniform(0.35, 0.65))) * WIDTH / 2
            draw = rng.random()
            if draw < 0.3:
                size = (float(rng.uniform(7, 10)), float(rng.uniform(7, 9)))
                front, yaw = float(rng.choice([-1, 1])), float(rng.normal(0, 0.05))
                site.solids += house(rng, Plot(x, y, *size, front, yaw))
                continue
            if draw < 0.6:
                site.solids.append(
                    border(rng, (x, y - 3.5), (float(rng.uniform(4, 10)), 0.5), True)
                )
            for _ in range(int(rng.integers(1, 5))):
                at = x + float(rng.uniform(-5, 5)), y + float(rng.uniform(-5, 5))
                site.solids += tree(rng, at, float(rng.uniform(0.9, 1.7)))


@dataclass(frozen=True)
class _Lot:
    """A stretch of one side of a street.

    Attributes:
        left, width: The extent along x.
        street: The y of the street's middle.
        front: The side of the street: +1 at larger y, -1 at smaller y.
    """

    left: float
    width: float
    street: float
    front: float

    @property
    def middle(self) -> float:
        return self.left + self.width / 2

    def deep(self, distance: float) -> float:
        """The y at a distance from the street's middle."""
        return self.street + self.front * distance


def _fill(cell: Cell, seed: int, site: _Site) -> None:
    rng = _random(seed, 11, cell)
    x0, y0 = cell[0] * LENGTH, cell[1] * WIDTH
    width = (LENGTH - 2 * STREET - 0.6) / PLOTS
    park = int(rng.integers(2 * PLOTS))
    for number in range(2 * PLOTS):
        left = x0 + STREET + 0.3 + (number % PLOTS) * width
        lot = _Lot(left, width, y0, 1.0 if number < PLOTS else -1.0)
        (_park if number == park else _plot)(rng, lot, site)
        if rng.random() < 0.55:
            at = left + float(rng.uniform(2.3, width - 2.3)), lot.deep(ROAD - 1.0)
            site.solids += car(rng, at)
    for side in (-1.0, 1.0):
        x = x0 + STREET + 1 + float(rng.uniform(0, 30))
        site.solids += lamp(rng, x, y0 + side * (ROAD + 0.3))


def _plot(rng: np.random.Generator, lot: _Lot, site: _Site) -> None:
    """A house between a front and a back garden."""
    width, depth = float(rng.uniform(0.68, 0.88) * lot.width), float(rng.uniform(7.0, 9.0))
    garden = float(rng.uniform(1.2, 3.4))
    x = lot.middle + float(rng.uniform(-0.5, 0.5)) * (lot.width - width - 0.6)
    y = lot.deep(STREET + garden + depth / 2)
    yaw = float(rng.normal(0, 0.02))
    site.solids += house(rng, Plot(x, y, width, depth, lot.front, yaw))
    gate = x + float(rng.uniform(-0.25, 0.25)) * width
    site.paved.append(_rectangle(gate, lot.deep(STREET + garden / 2), 1.5, garden + 0.3))
    site.paved.append(_rectangle(x, y + lot.front * (depth / 2 + 1.5), width * 0.7, 3.0))
    _enclose(rng, lot, gate, STREET + garden + depth, site)
    for _ in range(int(rng.integers(1, 4))):
        x = lot.left + float(rng.uniform(1.8, lot.width - 1.8))
        y = lot.deep(WIDTH / 2 - float(rng.uniform(2.2, 3.4)))
        site.solids += tree(rng, (x, y), float(rng.uniform(0.7, 1.0)))
    for _ in range(int(rng.integers(2, 6))):
        side = float(rng.uniform(0.3, max(0.4, garden - 0.5)))
        at = lot.left + float(rng.uniform(0.6, lot.width - 0.6))
        radius = float(rng.uniform(0.25, 0.55))
        site.solids.append(shrub(rng, (at, lot.deep(STREET + 0.15 + side)), radius))


def _enclose(rng: np.random.Generator, lot: _Lot, gate: float, back: float, site: _Site) -> None:
    """Place hedges, fences and walls around a plot; ``back`` is the distance of the house's rear
    from the street's middle."""
    right = lot.left + lot.width
    for a, b in ((lot.left + 0.1, gate - 0.75), (gate + 0.75, right - 0.1)):
        if b - a > 0.6 and rng.random() < 0.8:
            at = (a + b) / 2, lot.deep(STREET + 0.15)
            site.solids.append(border(rng, at, (b - a, 0.35)))
    end = WIDTH / 2 - 0.2
    site.solids.append(border(rng, (lot.middle, lot.deep(end)), (lot.width - 0.3, 0.3), tall=True))
    side = lot.left + 0.05, lot.deep((back + end) / 2)
    site.solids.append(border(rng, side, (0.25, end - back - 1.0), tall=True))


def _park(rng: np.random.Generator, lot: _Lot, site: _Site) -> None:
    """A small square: trees, benches, a kiosk and a monument on paved ground."""
    x, y = lot.middle, lot.deep(STREET + 7.0)
    site.paved.append(_rectangle(x, lot.deep(STREET + 5.0), 2.0, 10.5))
    site.paved.append(_rectangle(x, y, 7.0, 5.5))
    site.solids += monument(rng, (x, y + lot.front * 0.5))
    for sign in (-1, 1):
        for deep in (3.2, 13.0):
            at = x + sign * float(rng.uniform(3.6, 4.4)), lot.deep(STREET + deep)
            site.solids += tree(rng, at, float(rng.uniform(0.8, 1.1)))
        bench = x + sign * 2.6, y + lot.front * 1.2
        site.solids.append(box(bench, (1.6, 0.5, 0.45), 0.0, 0.0, faces(rng, (0.3, 0.16, 0.07))))
    kiosk = x + float(rng.uniform(-2, 2)), lot.deep(STREET + 14.0)
    sides = faces(rng, pick(rng, PAINTS), FLAT_ROOF)
    site.solids.append(box(kiosk, (3.6, 2.6, 2.7), 0.0, float(rng.normal(0, 0.1)), sides))


def _rectangle(x: float, y: float, width: float, depth: float) -> Array:
    a, b = width / 2, depth / 2
    return np.array([[x - a, y - b], [x + a, y - b], [x + a, y + b], [x - a, y + b]])
