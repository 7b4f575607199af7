"""The camera path through the town: a flight over each cell, then a walk along its street.

Each photograph overlaps well with the one before, and flights over neighbouring cells with each
other, so the first photographs are connected whatever their number.
"""

from __future__ import annotations

from itertools import islice

import numpy as np
from numpy.typing import NDArray

from benchmarks.town.layout import LENGTH, WIDTH, Cell, spiral
from pipeline.demo.cameras import look_at
from pipeline.scene.reconstruction import PosedImage

Array = NDArray[np.float64]

# The flight: strips along x, by the middle of their footprints, and the tilt towards +y that
# brings them there, degrees. Footprints overlap by about 75 % along a strip, and by 65 to 70 %
# between strips.
ALTITUDE = 34.0
STRIPS = ((-17.6, 20.0), (-8.8, 0.0), (0.0, -20.0), (8.8, 0.0), (17.6, 20.0))
SHOTS = 5  # on a strip
LINK = (12.0, 8.8)  # where one photograph is taken between the last strip and the descent
# The descent into the street: elevations of the camera above a point of the street, degrees.
ELEVATIONS = (80, 70, 60, 50, 40, 31, 22, 14, 7)
# The walk: along one pavement and back on the other, turning at the end.
STEPS = 17
TURN = 3
SWING = (10.0, 110.0)  # directions to the right of the way at its begin and end, degrees
HEIGHT = 1.7
PAVEMENT = 4.7  # at its outer edge: parked cars hide less of the other side
EDGE = 2.0  # distance of the walk's ends from those of the cell

PHOTOGRAPHS_PER_CELL = SHOTS * len(STRIPS) + 1 + len(ELEVATIONS) + 2 * STEPS + TURN


def cells_of(photographs: int) -> tuple[Cell, ...]:
    """The cells of a town of some photographs: their number, and so the area, is proportional."""
    return spiral(max(1, -(-photographs // PHOTOGRAPHS_PER_CELL)))


def camera_path(names: list[str], seed: int) -> list[PosedImage]:
    """Cameras in order; the first are the same for any number of photographs."""
    cells = cells_of(len(names))
    shots = (shot for cell in cells for shot in _cell(cell, seed))
    posed = []
    for name, (centre, rotation) in zip(names, islice(shots, len(names)), strict=True):
        posed.append(PosedImage(name, 1, rotation, -np.asarray((rotation * centre).sum(1))))
    return posed


def _cell(cell: Cell, seed: int) -> list[tuple[Array, Array]]:
    rng = np.random.default_rng([seed, 12, cell[0] + 100_000, cell[1] + 100_000])
    corner = np.array([cell[0] * LENGTH, cell[1] * WIDTH, 0.0])
    shots = [*_flight(), *_descent(), *_walk()]
    moved = []
    for centre, rotation in shots:
        shake = rng.normal(0, 1, 6)
        limit = 0.5 if centre[2] > 10 else 0.05
        centre = centre + limit * np.clip(shake[:3], -2, 2)
        moved.append((corner + centre, _turned(rotation, 0.015 * shake[3:])))
    return moved


def _flight() -> list[tuple[Array, Array]]:
    shots = []
    for number, (middle, tilt) in enumerate(STRIPS):
        lean = np.tan(np.radians(tilt))
        along = (np.arange(SHOTS) + 0.5) * LENGTH / SHOTS
        # A strip runs from the far end to the near one, and the next one back, so that the last
        # ends where the walk begins.
        for x in along[::-1] if number % 2 == 0 else along:
            centre = np.array([x, middle - ALTITUDE * lean, ALTITUDE])
            shots.append((centre, _tilted(tilt)))
    shots.append((np.array([*LINK, ALTITUDE]), _tilted(0.0)))
    return shots


def _tilted(degrees: float) -> Array:
    """The rotation of a camera that looks down, tilted towards +y, with +x to the right."""
    angle = np.radians(degrees)
    forward, right = np.array([0.0, np.sin(angle), -np.cos(angle)]), np.array([1.0, 0.0, 0.0])
    return np.stack([right, np.cross(forward, right), forward])


def _descent() -> list[tuple[Array, Array]]:
    """The descent along an arc around a point of the street, looking at it along the street."""
    shots = []
    for i, degrees in enumerate(ELEVATIONS):
        share = i / (len(ELEVATIONS) - 1)
        target = np.array([19.0 + share * 4, 0.0, 1.2])
        radius = 30.0 - 10.0 * share
        elevation = np.radians(degrees)
        back = np.array([-np.cos(elevation), 0.06 * share, np.sin(elevation)])
        centre = target + radius * back
        shots.append((centre, look_at(centre, target)))
    return shots


def _walk() -> list[tuple[Array, Array]]:
    """The walk along the pavement at +y and back on the other one, looking ahead, to the far side,
    and at last back."""
    shots = []
    along = np.linspace(EDGE, LENGTH - EDGE, STEPS)
    swing = np.linspace(*SWING, STEPS)
    for x, angle in zip(along, swing, strict=True):
        shots.append(_standing(x, PAVEMENT, -angle))
    for i in range(1, TURN + 1):
        share = i / (TURN + 1)
        x = LENGTH - EDGE + 1.2 * np.sin(np.pi * share)
        heading = -(1 - share) * swing[-1] - share * (180 + swing[0])
        shots.append(_standing(x, PAVEMENT * np.cos(np.pi * share), heading))
    for x, angle in zip(along[::-1], swing, strict=True):
        shots.append(_standing(x, -PAVEMENT, 180 - angle))
    return shots


def _standing(x: float, y: float, heading: float) -> tuple[Array, Array]:
    """A camera at the height of a pedestrian; heading in degrees from +x towards +y."""
    centre = np.array([x, y, HEIGHT])
    angle = np.radians(heading)
    ahead = np.array([np.cos(angle), np.sin(angle), 0.06])
    return centre, look_at(centre, centre + ahead)


def _turned(rotation: Array, angles: Array) -> Array:
    """A rotation, turned further about the camera's axes by small angles, radians."""
    turned = rotation
    for axis, angle in enumerate(angles):
        c, s = np.cos(angle), np.sin(angle)
        first, second = (axis + 1) % 3, (axis + 2) % 3
        rows = turned.copy()
        rows[first] = c * turned[first] + s * turned[second]
        rows[second] = c * turned[second] - s * turned[first]
        turned = rows
    return turned
