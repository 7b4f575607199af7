"""Synthetic scenes to move in: an object, a facade and a room, each with far content behind it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.reporting.data import TrainedScene
from pipeline.scene.views import View
from pipeline.splats.arrays import GaussianArrays

Array = NDArray[np.float64]


class World(NamedTuple):
    """A scene and where one may be in it.

    Attributes:
        scene: The scene, z up.
        subject: (P, 3) points of what was photographed.
        distance: The typical distance of the cameras from it.
        allows: Whether a viewpoint, (3,), is one that photographs could have been taken from.
        turn: The least and the largest angle, in degrees, that one can orbit.
    """

    name: str
    scene: TrainedScene
    subject: Array
    distance: float
    allows: Callable[[Array], bool]
    turn: tuple[float, float]


def look_at(eye: Sequence[float], target: Sequence[float], name: str) -> View:
    """An upright camera, z up."""
    forward = np.subtract(target, eye, dtype=float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(eye, float)
    return View(name, "", None, 200, 150, 180.0, 180.0, 100.0, 75.0, pose, False)


def textured(points: Array, size: float, rng: np.random.Generator) -> GaussianArrays:
    """Opaque balls of random colours at these points."""
    count = len(points)
    return GaussianArrays(
        means=points.astype(np.float32),
        log_scales=np.full((count, 3), np.log(size), np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        opacity_logits=np.full(count, 3.0, np.float32),
        sh=rng.normal(0, 1, (count, 1, 3)).astype(np.float32),
    )


def world(
    name: str,
    subject: Array,
    eyes: Sequence[tuple[Sequence[float], Sequence[float]]],
    allows: Callable[[Array], bool],
    turn: tuple[float, float],
    size: float,
) -> World:
    """Of these points and cameras (eye and target), in a shell of far Gaussians."""
    rng = np.random.default_rng(3)
    sky = rng.normal(size=(600, 3))
    sky *= 60 / np.linalg.norm(sky, axis=1, keepdims=True)
    parts = [textured(subject, size, rng), textured(sky, 5.0, rng)]
    whole = GaussianArrays(
        **{name: np.concatenate([p.arrays()[name] for p in parts]) for name in parts[0].arrays()}
    )
    views = [look_at(eye, target, f"{i}.jpg") for i, (eye, target) in enumerate(eyes)]
    scene = TrainedScene(whole, views, {}, (0.5, 0.5, 0.5), False, 0.03)
    distance = np.median([np.linalg.norm(np.subtract(eye, target)) for eye, target in eyes])
    return World(name, scene, subject, float(distance), allows, turn)


def an_object() -> World:
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(1200, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    angles = np.arange(12) * np.pi / 6
    eyes = [((4 * np.cos(a), 4 * np.sin(a), 1.2), (0, 0, 0)) for a in angles]

    def allows(eye: Array) -> bool:
        return bool(1.05 < np.linalg.norm(eye) < 6 and abs(eye[2]) < 4.5)

    return world("object", ball, eyes, allows, (300, 1e9), 0.08)


def a_facade() -> World:
    """In the plane y = 0, photographed from the side of negative y."""
    rng = np.random.default_rng(1)
    wall = np.column_stack([rng.uniform(-6, 6, 2000), np.zeros(2000), rng.uniform(0, 6, 2000)])
    eyes = [((x, -5, 1.7), (0.6 * x, 0, 2.5)) for x in np.linspace(-4, 4, 9)]

    def allows(eye: Array) -> bool:
        return bool(-7.5 < eye[1] < -0.8 and abs(eye[0]) < 9)

    return world("facade", wall, eyes, allows, (15, 150), 0.12)


def a_room() -> World:
    """8 m by 8 m by 3 m; each camera looks from one side of the middle at the opposite wall."""
    rng = np.random.default_rng(2)
    walls = rng.uniform([-4, -4, 0], [4, 4, 3], (3000, 3))
    side = rng.integers(0, 6, 3000)
    for axis, (low, high) in enumerate([(-4, 4), (-4, 4), (0, 3)]):
        walls[side == 2 * axis, axis] = low
        walls[side == 2 * axis + 1, axis] = high
    angles = np.arange(16) * np.pi / 8
    eyes = [
        ((-2 * np.cos(a), -2 * np.sin(a), 1.6), (3 * np.cos(a), 3 * np.sin(a), 1.4)) for a in angles
    ]

    def allows(eye: Array) -> bool:
        return bool((np.abs(eye[:2]) < 4).all() and 0 < eye[2] < 3)

    return world("room", walls, eyes, allows, (15, 220), 0.15)


WORLDS = (an_object(), a_facade(), a_room())
