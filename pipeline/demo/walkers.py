"""Walking figures in photographs of the demo scene, which are not part of the scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.demo.render import Rays
from pipeline.demo.scene import OBJECTS, SceneObject, distance, trace
from pipeline.demo.shapes import Cylinder, Shape, Sphere
from pipeline.demo.textures import Material
from pipeline.scene.reconstruction import PosedImage

Array = NDArray[np.float64]

MOST = 3
COVERED = 0.05, 0.15  # Bounds of the share of the pixels that the figures cover.
HEIGHTS = 1.0, 1.7
DEPTHS = 1.2, 3.5  # Metres in front of the camera.
SIDEWAYS = 0.55  # The largest distance from the middle of the photograph, as a share of the depth.
CLEARANCE = 0.25  # Metres between the axis of a figure and the scene.
TRIES = 300
# Every so many pixels and rows are traced to measure the covered share.
COARSE = 6


def walkers(posed: PosedImage, through: Rays, seed: int, number: int) -> tuple[SceneObject, ...]:
    """One to three figures on the floor, which cover a share of a photograph within ``COVERED``, or
    near it if the camera has no place for them.

    Args:
        posed: The camera.
        through: The rays of the camera.
        number: The number of the photograph.
    """
    rng = np.random.default_rng([seed, 8, number])
    rays = through.centres[:, ::COARSE, ::COARSE].reshape(3, -1)
    right, down, forward = (row[:, None] for row in posed.rotation)
    directions = right * rays[0] + down * rays[1] + forward * rays[2]
    low, high = COVERED
    best: tuple[SceneObject, ...] = ()
    smallest = np.inf
    for _ in range(TRIES):
        figures: list[SceneObject] = []
        for _ in range(rng.integers(1, MOST + 1)):
            figures += _figure(rng, posed)
        if not figures:
            continue
        _, index = trace(posed.centre[:, None], directions, (*OBJECTS, *figures))
        share = float((index >= len(OBJECTS)).mean())
        excess = max(low - share, share - high, 0.0)
        if excess < smallest:
            best, smallest = tuple(figures), excess
        if excess == 0:
            break
    return best


def _figure(rng: np.random.Generator, posed: PosedImage) -> list[SceneObject]:
    """A figure at a random place in front of the camera; empty if the place is not free."""
    height, depth = rng.uniform(*HEIGHTS), rng.uniform(*DEPTHS)
    aside, heading = rng.uniform(-SIDEWAYS, SIDEWAYS) * depth, rng.uniform(0, 2 * np.pi)
    ahead, across = posed.rotation[2, :2], posed.rotation[0, :2]
    place = posed.centre[:2] + depth * ahead / np.linalg.norm(ahead) + aside * across
    colours = rng.uniform(0.05, 0.7, (2, 3))
    shirt, trousers = (_cloth(colour, int(rng.integers(2**31))) for colour in colours)
    levels = np.array([0.3, 0.6, 0.9, 1.2])  # Farther from the floor than ``CLEARANCE``.
    column = np.stack([np.full(4, place[0]), np.full(4, place[1]), levels])
    if distance(column).min() < CLEARANCE:
        return []
    step = 0.09 * height * np.array([np.cos(heading), np.sin(heading)])
    side = 0.15 * height * np.array([-np.sin(heading), np.cos(heading)])

    def limb(offset: Array, radius: float, bottom: float, top: float) -> Cylinder:
        x, y = (place + offset).tolist()
        return Cylinder((x, y), radius * height, bottom * height, top * height)

    def ball(level: float, radius: float) -> Sphere:
        x, y = place.tolist()
        return Sphere((x, y, level * height), radius * height)

    dressed: list[tuple[Material, list[Shape]]] = [
        (trousers, [limb(step, 0.055, 0.0, 0.5), limb(-step, 0.055, 0.0, 0.5), ball(0.48, 0.11)]),
        (shirt, [limb(0 * step, 0.11, 0.48, 0.76), ball(0.76, 0.11)]),
        (shirt, [limb(side, 0.035, 0.42, 0.78), limb(-side, 0.035, 0.42, 0.78)]),
        (SKIN, [ball(0.93, 0.07)]),
    ]
    return [SceneObject(shape, material) for material, shapes in dressed for shape in shapes]


def _cloth(colour: Array, seed: int) -> Material:
    r, g, b = colour.tolist()
    return Material((r, g, b), (0.2 * r, 0.2 * g, 0.2 * b), (0.05, 0.0, -0.05), 0.05, 0.4, seed)


SKIN = Material((0.48, 0.28, 0.20), (0.04, 0.03, 0.02), (0.02, 0.0, 0.0), 0.05, 0.3, 20)
