"""Synthetic captures: successful ones, failing ones, and ones with plausible but wrong models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.judge.world import Array, Made, Shot, Surface, ball, looking, plane, room

Case = Callable[[np.random.Generator], Made]

ORBIT_RADIUS = 2.6


def _things(rng: np.random.Generator, count: int = 2600) -> Surface:
    """A few balls: all sides differ."""
    total = ball(rng, np.array([0.0, 0.0, 0.7]), 0.6, count // 2)
    for centre, radius in (((0.9, 0.3, 0.35), 0.35), ((-0.7, 0.6, 0.4), 0.4)):
        total = total + ball(rng, np.array(centre), radius, count // 4)
    return total


_SOLID = (
    (np.array([0.0, 0.0, 0.7]), 0.6),
    (np.array([0.9, 0.3, 0.35]), 0.35),
    (np.array([-0.7, 0.6, 0.4]), 0.4),
)


def _ring(rng: np.random.Generator, count: int, degrees: float = 360.0, **facts: Any) -> list[Shot]:
    start = rng.uniform(0, 2 * np.pi)
    steps = np.arange(count) / (count if degrees == 360 else max(count - 1, 1))
    shots = []
    for angle in start + np.radians(degrees) * steps:
        radius = ORBIT_RADIUS + rng.uniform(-0.25, 0.25)
        centre = np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.8, 1.5)])
        target = np.array([0.0, 0.0, 0.6]) + rng.uniform(-0.15, 0.15, 3)
        shots.append(looking(centre, target, rng.uniform(-0.1, 0.1), **facts))
    return shots


def _heap(rng: np.random.Generator, shots: list[Shot]) -> Made:
    return Made([_things(rng) + room(rng, 7.0, 3500)], shots, solid=_SOLID)


def orbit(rng: np.random.Generator, count: int = 18, **facts: Any) -> Made:
    return _heap(rng, _ring(rng, count, **facts))


def _facing(rng: np.random.Generator, count: int, step: float, relief: float) -> Made:
    """A row of cameras along a wall with this relief (its height is 4)."""
    length = 6 + step * count
    wall = plane(rng, (-3, 3, 0), (length, 0, 0), (0, 0, 4), int(500 * length), relief)
    shots = []
    for i in range(count):
        centre = np.array([i * step, rng.uniform(-0.3, 0.3), rng.uniform(1.5, 2.2)])
        ahead = np.array([rng.uniform(-0.3, 0.3), 3.0, rng.uniform(-0.2, 0.2)])
        shots.append(looking(centre, centre + ahead, rng.uniform(-0.05, 0.05)))
    return Made([wall], shots)


def _street(rng: np.random.Generator, count: int, step: float, **facts: Any) -> Made:
    """Forward motion along a street, as of a dash camera."""
    length = 30 + count * step
    sides = (
        plane(rng, (-4, length, 0), (0, -length, 0), (0, 0, 6), int(120 * length), -0.6)
        + plane(rng, (4, 0, 0), (0, length, 0), (0, 0, 6), int(120 * length), -0.6)
        + plane(rng, (-4, 0, 0), (8, 0, 0), (0, length, 0), int(100 * length))
        + plane(rng, (-8, length + 5, 0), (16, 0, 0), (0, 0, 8), 150, 2.0)
    )
    shots = []
    for i in range(count):
        centre = np.array([rng.normal(0, 0.05), i * step, 1.6 + rng.normal(0, 0.02)])
        ahead = np.array([rng.normal(0, 0.1), 10.0, rng.normal(0, 0.1)])
        shots.append(looking(centre, centre + ahead, rng.normal(0, 0.01), **facts))
    return Made([sides], shots)


def _turning(rng: np.random.Generator, count: int, sway: float) -> Made:
    """Rotation on the spot in a room of side 7; ``sway`` is the movement of the camera, metres."""
    shots = []
    for i in range(count):
        angle = 2 * np.pi * i / count
        centre = np.array([0, 0, 1.5]) + rng.normal(0, sway, 3)
        ahead = np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.15, 0.15)])
        shots.append(looking(centre, centre + ahead))
    return Made([room(rng, 7.0, 5000)], shots)


def _tower(rng: np.random.Generator, count: int, sides: int, unlike: float, ground: int) -> Made:
    """Cameras around a building of ``sides`` equal sides; ``unlike`` is the share of points that
    only one side has; ``ground`` is the number of points of the ground, all different."""
    per_side = 1000
    base = plane(rng, (-1, -1, 0), (2, 0, 0), (0, 0, 2.4), per_side, -0.25)
    total = None
    for k in range(sides):
        angle = 2 * np.pi * k / sides
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        look = base.look.copy()
        own = rng.permutation(per_side)[: int(unlike * per_side)]
        look[own] = per_side * (k + 1) + own
        side = Surface(base.xyz @ turn.T, base.normal @ turn.T, look)
        total = (
            side
            if total is None
            else Surface(
                np.concatenate([total.xyz, side.xyz]),
                np.concatenate([total.normal, side.normal]),
                np.concatenate([total.look, side.look]),
            )
        )
    assert total is not None
    if ground:
        total = total + plane(rng, (-7, -7, 0), (14, 0, 0), (0, 14, 0), ground)
    shots = []
    for i in range(count):
        angle = 2 * np.pi * i / count
        radius = 4.2 + rng.uniform(-0.2, 0.2)
        centre = np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(1.4, 2.0)])
        shots.append(looking(centre, np.array([0, 0, 1.1]) + rng.uniform(-0.1, 0.1, 3)))
    return Made([total], shots, solid=((np.array([0, 0, 1.0]), 0.95),))


def _windows(rng: np.random.Generator, count: int, unlike: float) -> Made:
    """Cameras along a facade of equal windows, so near that a picture shows less than two;
    ``unlike`` is the share of points that do not repeat."""
    period, length = 3.0, 24.0
    wall = plane(rng, (-3, 2.2, 0), (length, 0, 0), (0, 0, 4), 9000, 0.3)
    tile = np.floor((wall.xyz[:, 0] + 3) / period)
    first = tile == 0
    cells = int(length / period)
    inside = Surface(wall.xyz[first], wall.normal[first], np.arange(int(first.sum())))
    xyz, normal, look = [], [], []
    for k in range(cells):
        own = rng.uniform(size=len(inside.look)) < unlike
        xyz.append(inside.xyz + np.array([k * period, 0, 0]))
        normal.append(inside.normal)
        look.append(np.where(own, len(own) * (k + 1) + inside.look, inside.look))
    facade = Surface(np.concatenate(xyz), np.concatenate(normal), np.concatenate(look))
    shots = []
    for i in range(count):
        x = -1.5 + (length - 4.0) * i / (count - 1)
        centre = np.array([x, rng.uniform(-0.1, 0.1), rng.uniform(1.7, 2.2)])
        shots.append(looking(centre, centre + np.array([rng.uniform(-0.1, 0.1), 2.2, 0])))
    return Made([facade], shots)


def _with_prior(case: Case, factor: float) -> Case:
    def made(rng: np.random.Generator) -> Made:
        good = case(rng)
        return replace(good, shots=[replace(shot, prior=factor) for shot in good.shots])

    return made


def _blurred(rng: np.random.Generator) -> Made:
    return orbit(rng, blur=4.0)


def _two_rooms(rng: np.random.Generator) -> Made:
    first = orbit(rng, 16)
    second = [replace(shot, scene=1) for shot in _ring(rng, 14)]
    other = _things(rng) + room(rng, 7.0, 3500)
    return replace(first, scenes=[first.scenes[0], other], shots=[*first.shots, *second])


def _mixed(rng: np.random.Generator) -> Made:
    """Photographs of three scenes in one folder, none with half of them."""
    heaps = [_things(rng) + room(rng, 7.0, 3500) for _ in range(3)]
    shots = [replace(shot, scene=k) for k in range(3) for shot in _ring(rng, 15)]
    return Made(heaps, shots, solid=_SOLID)


def _outliers(rng: np.random.Generator) -> Made:
    """Three of ten photographs each show a different scene."""
    good = orbit(rng, 18)
    scenes, shots = list(good.scenes), list(good.shots)
    for k in range(8):
        scenes.append(room(rng, 7.0, 5000))
        turn = rng.uniform(0, 2 * np.pi)
        shots.append(looking((0, 0, 1.5), (np.cos(turn), np.sin(turn), 1.4), scene=k + 1))
    return replace(good, scenes=scenes, shots=shots)


def _duplicates(rng: np.random.Generator) -> Made:
    good = orbit(rng, 12)
    copies = [replace(shot, copy_of=i) for i, shot in enumerate(good.shots)]
    return replace(good, shots=[*good.shots, *copies])


def _one_photo_many_times(rng: np.random.Generator) -> Made:
    good = orbit(rng, 1)
    return replace(good, shots=[good.shots[0], *[replace(good.shots[0], copy_of=0)] * 7])


def _two_photos_many_times(rng: np.random.Generator) -> Made:
    """Two standpoints, each photographed four times from a tripod."""
    good = _heap(rng, _ring(rng, 2, 8.0))
    return replace(good, shots=[shot for shot in good.shots for _ in range(4)])


def _mirrored(rng: np.random.Generator) -> Made:
    """Every third photograph is mirrored."""
    good = orbit(rng, 30)
    shots = [replace(shot, mirrored=i % 3 == 0) for i, shot in enumerate(good.shots)]
    return replace(good, shots=shots)


def _wide_distortion(rng: np.random.Generator) -> Made:
    return replace(orbit(rng), radial=-0.22)


def _cameras_each(rng: np.random.Generator) -> Made:
    good = orbit(rng)
    shots = [replace(shot, camera=i) for i, shot in enumerate(good.shots)]
    return replace(good, shots=shots)


def _wrong_priors_each(rng: np.random.Generator) -> Made:
    good = orbit(rng)
    shots = [
        replace(shot, camera=i, prior=float(np.exp(rng.uniform(np.log(0.3), np.log(3)))))
        for i, shot in enumerate(good.shots)
    ]
    return replace(good, shots=shots)


def _sparse_texture(rng: np.random.Generator) -> Made:
    """Almost no texture: a few dozen keypoints per image."""
    return Made([_things(rng, 120) + room(rng, 7.0, 100)], _ring(rng, 20), solid=_SOLID)


def _plain(rng: np.random.Generator) -> Made:
    """Slightly more texture: enough for a chain of verified pairs."""
    return Made([_things(rng, 320) + room(rng, 7.0, 250)], _ring(rng, 24), solid=_SOLID)


CASES: dict[str, Case] = {
    # Captures that should succeed.
    "orbit": orbit,
    "orbit_prior_right": _with_prior(orbit, 1.0),
    "orbit_camera_each": _cameras_each,
    "orbit_distorted": _wide_distortion,
    "few_views": lambda rng: _heap(rng, _ring(rng, 6, 50.0)),
    "three_views": lambda rng: _heap(rng, _ring(rng, 3, 20.0)),
    "arc": lambda rng: _heap(rng, _ring(rng, 16, 120.0)),
    "planar": lambda rng: _facing(rng, 14, 0.35, 0.02),
    "relief": lambda rng: _facing(rng, 14, 0.35, 0.8),
    "long_row": lambda rng: _facing(rng, 36, 0.6, 0.6),
    "street": lambda rng: _street(rng, 14, 1.0),
    "outliers_30": _outliers,
    "duplicates": _duplicates,
    "mirrored_third": _mirrored,
    # Captures that give partial models.
    "two_rooms": _two_rooms,
    "mixed_three": _mixed,
    # Captures that give plausible but wrong models, or none.
    **{f"prior_x{f}": _with_prior(orbit, f) for f in (0.3, 0.5, 0.7, 1.5, 2.0, 3.0)},
    **{
        f"row_prior_x{f}": _with_prior(lambda rng: _facing(rng, 14, 0.35, 0.8), f)
        for f in (0.3, 0.5, 2.0, 3.0)
    },
    **{
        f"planar_prior_x{f}": _with_prior(lambda rng: _facing(rng, 14, 0.35, 0.02), f)
        for f in (0.5, 2.0)
    },
    **{
        f"street_prior_x{f}": _with_prior(lambda rng: _street(rng, 14, 1.0), f)
        for f in (0.3, 0.5, 2.0, 3.0)
    },
    "priors_wrong_each": _wrong_priors_each,
    "turning": lambda rng: _turning(rng, 16, 0.0),
    "turning_by_hand": lambda rng: _turning(rng, 16, 0.02),
    "turning_step": lambda rng: _turning(rng, 16, 0.25),
    "street_slow": lambda rng: _street(rng, 12, 0.05),
    "tower_2_sides": lambda rng: _tower(rng, 24, 2, 0.1, 4000),
    "tower_4_sides": lambda rng: _tower(rng, 24, 4, 0.1, 4000),
    "tower_4_bare": lambda rng: _tower(rng, 24, 4, 0.1, 600),
    "tower_unlike": lambda rng: _tower(rng, 24, 4, 0.6, 4000),
    "windows": lambda rng: _windows(rng, 24, 0.15),
    "windows_unlike": lambda rng: _windows(rng, 24, 0.5),
    "one_photo_8_times": _one_photo_many_times,
    "two_places_4_times": _two_photos_many_times,
    "blurred": _blurred,
    "almost_bare": _sparse_texture,
    "plain": _plain,
}


def make(name: str, seed: int) -> Made:
    return CASES[name](np.random.default_rng([seed, sum(name.encode())]))


__all__ = ["CASES", "Array", "make"]
