"""Rendered worlds with parts that look alike, as unordered photographs and as frames of a video.

The texture of a body repeats by rotation about the vertical or by translation. The ground, the
horizon and a few objects do not repeat, so that the photographs determine the true poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.demo.cameras import lens, look_at
from pipeline.demo.shapes import Array, Box, Cylinder, Shape, Sphere
from pipeline.demo.textures import Floats, Material
from pipeline.geometry.cameras import Camera
from pipeline.scene.reconstruction import PosedImage, Reconstruction

WIDTH, HEIGHT = 480, 360
PHOTOGRAPHS, FRAMES = 36, 90
# Sigma of the blur by the lens and the pixel, pixels.
BLUR = 0.7
NOISE = 0.004
LIGHT = np.array([0.36, 0.48, 0.80])


@dataclass(frozen=True)
class Body:
    """A shape whose texture repeats.

    Attributes:
        turns: The number of equal parts around the vertical axis.
        period: The length after which the texture repeats along x; 0 for none.
    """

    shape: Shape
    material: Material
    turns: int = 1
    period: float = 0.0

    def colour(self, point: Array, blur: Array) -> Floats:
        """(3, N) linear RGB at (3, N) points, with a blur of (N,) sigma."""
        p = point.copy()
        if self.turns > 1:
            sector = 2 * np.pi / self.turns
            # Sectors begin between the directions of the faces.
            angle = -sector * np.floor(np.arctan2(p[1], p[0]) / sector + 0.5)
            c, s = np.cos(angle), np.sin(angle)
            p[0], p[1] = c * point[0] - s * point[1], s * point[0] + c * point[1]
        if self.period:
            p[0] %= self.period
        return self.material.albedo(p.astype(np.float32), blur.astype(np.float32))


@dataclass(frozen=True)
class World:
    """Bodies and the path of the camera.

    Attributes:
        path: The kind of path: around the bodies, inside them, or along the street.
    """

    bodies: tuple[Body, ...]
    path: str = "around"


def _material(rng: np.random.Generator, finest: float, coarsest: float) -> Material:
    def tint(scale: float) -> tuple[float, float, float]:
        a, b, c = (float(v) for v in rng.uniform(-scale, scale, 3))
        return a, b, c

    base = tuple(float(v) for v in rng.uniform(0.3, 0.5, 3))
    bright = tuple(float(v) for v in rng.uniform(0.15, 0.3, 3))
    seed = int(rng.integers(1 << 30))
    return Material(base, bright, tint(0.15), finest, coarsest, seed)  # type: ignore[arg-type]


def _surroundings(rng: np.random.Generator, reach: float, wall: float) -> list[Body]:
    """The ground, a horizon of this distance, and three objects at the distance ``reach``."""
    bodies = [
        Body(Box((0, 0, -0.5), (wall, wall, 0.5)), _material(rng, 0.12, 1.5)),
        Body(Box((0, 0, 3.0), (wall, wall, 3.2), inside=True), _material(rng, 0.5, 4.0)),
    ]
    start = rng.uniform(0, 2 * np.pi)
    for k in range(3):
        angle = start + k * 2.1 + rng.uniform(-0.4, 0.4)
        x, y = (float(v) for v in reach * np.array([np.cos(angle), np.sin(angle)]))
        size = float(rng.uniform(0.12, 0.22))
        shape: Shape = Sphere((x, y, size), size)
        if k % 2:
            shape = Box((x, y, size), (size, 0.8 * size, size), angle)
        bodies.append(Body(shape, _material(rng, 0.05, 0.4)))
    return bodies


def _can(rng: np.random.Generator, turns: int) -> World:
    own = Body(Cylinder((0.0, 0.0), 0.7, 0.0, 1.6), _material(rng, 0.05, 0.6), turns)
    return World((own, *_surroundings(rng, 1.2, 5.0)))


def _box(rng: np.random.Generator, half: tuple[float, float, float], turns: int) -> World:
    own = Body(Box((0.0, 0.0, half[2]), half), _material(rng, 0.05, 0.6), turns)
    return World((own, *_surroundings(rng, 1.3, 5.0)))


def _temple(rng: np.random.Generator) -> World:
    """A round temple: eight columns around a core, on a base and below a roof, all repeated."""
    stone, column = _material(rng, 0.05, 0.5), _material(rng, 0.05, 0.5)
    bodies = [
        Body(Cylinder((0.0, 0.0), 0.95, 0.0, 0.15), stone, 8),
        Body(Cylinder((0.0, 0.0), 0.95, 1.35, 1.7), stone, 8),
        Body(Cylinder((0.0, 0.0), 0.5, 0.15, 1.35), stone, 8),
    ]
    for k in range(8):
        x, y = 0.8 * np.cos(k * np.pi / 4), 0.8 * np.sin(k * np.pi / 4)
        bodies.append(Body(Cylinder((float(x), float(y)), 0.11, 0.15, 1.35), column, 8))
    return World((*bodies, *_surroundings(rng, 1.4, 5.0)))


def _courtyard(rng: np.random.Generator) -> World:
    walls = Body(Box((0, 0, 1.5), (3.5, 3.5, 2.0), inside=True), _material(rng, 0.12, 1.4), 4)
    return World((walls, _surroundings(rng, 1.6, 3.6)[0], *_surroundings(rng, 2.6, 4)[2:]), "in")


def _dome(rng: np.random.Generator) -> World:
    stone = _material(rng, 0.05, 0.6)
    drum = Body(Cylinder((0.0, 0.0), 0.8, 0.0, 0.8), stone, 6)
    dome = Body(Sphere((0.0, 0.0, 0.8), 0.8), replace(stone, seed=stone.seed + 1), 6)
    return World((drum, dome, *_surroundings(rng, 1.3, 5.0)))


def _facades(rng: np.random.Generator) -> World:
    """Equal facades along x; the pavement and the objects in front of them differ."""
    wall, lengths = _material(rng, 0.06, 0.8), 12.0
    facade = Body(Box((0.0, 2.0, 1.5), (lengths, 0.3, 1.5)), wall, period=1.5)
    ground = Body(Box((0, 0, -0.5), (lengths, 8, 0.5)), _material(rng, 0.12, 1.5))
    sky = Body(Box((0, 0, 3.0), (14, 9, 3.2), inside=True), _material(rng, 0.5, 4.0))
    things = []
    for x in np.arange(-6.0, 6.1, 1.1):
        size = float(rng.uniform(0.1, 0.25))
        at = (float(x + rng.uniform(-0.4, 0.4)), float(rng.uniform(1.1, 1.5)), size)
        things.append(Body(Sphere(at, size), _material(rng, 0.05, 0.4)))
    return World((facade, ground, sky, *things), "along")


def _world(name: str, seed: int) -> World:
    rng = np.random.default_rng([seed, sum(name.encode())])
    if name.startswith("can"):
        return _can(rng, int(name[-1]))
    if name.startswith("box"):
        half = (0.8, 0.45, 0.7) if name == "box_2" else (0.6, 0.6, 0.8)
        return _box(rng, half, int(name[-1]))
    made = {"temple": _temple, "courtyard": _courtyard, "dome": _dome, "facades": _facades}
    return made[name](rng)


WORLDS = ("can_2", "can_3", "box_2", "box_4", "temple", "courtyard", "dome", "facades")
LOOK_ALIKES = tuple(f"{world}{kind}" for world in WORLDS for kind in ("", "_video"))


def _poses(path: str, count: int, video: bool, rng: np.random.Generator) -> list[PosedImage]:
    """The poses in the order of the path: once around with a small overlap, or along x. A video
    moves smoothly; photographs are taken by hand at about equal steps."""
    phase = rng.uniform(0, 2 * np.pi, 4)
    loose = 0.0 if video else 1.0
    posed = []
    for i in range(count):
        share = i / (count - 1)
        angle = phase[0] + share * 2 * np.pi * (1.03 if video else 1 - 1 / count)
        wave = np.sin(3 * angle + phase[1:])
        jitter = loose * rng.uniform(-1, 1, 6)
        if path == "along":
            centre = np.array([-4.5 + 9 * share, -0.8, 1.1])
            target = centre + np.array([0.35 * wave[0], 2.0, -0.25])
        elif path == "in":
            out = np.array([np.cos(angle), np.sin(angle), 0.0])
            centre = np.array([0, 0, 1.3]) - 1.4 * out
            target = np.array([0, 0, 1.2]) + 2.0 * out
        else:
            centre = np.array([3.0 * np.cos(angle), 3.0 * np.sin(angle), 1.4])
            target = np.array([0.0, 0.0, 0.7])
        centre = centre + 0.12 * wave * (1, 1, 0.8) + 0.12 * jitter[:3]
        target = target + 0.08 * jitter[3:]
        rotation = look_at(centre, target, 0.04 * wave[2] + 0.04 * jitter[0])
        posed.append(PosedImage("", 1, rotation, -rotation @ centre))
    return posed


def _picture(posed: PosedImage, camera: Camera, flat: Array, bodies: tuple[Body, ...]) -> Array:
    """(H, W, 3) linear light."""
    origin, direction = posed.centre[:, None], posed.rotation.T @ flat
    hits = np.stack([body.shape.hit(origin, direction) for body in bodies])
    nearest = hits.argmin(0)
    t = np.minimum(hits.min(0), 100.0)
    light = np.zeros(direction.shape)
    for k, body in enumerate(bodies):
        here = np.flatnonzero(nearest == k)
        if len(here):
            point = origin + t[here] * direction[:, here]
            shade = 0.75 + 0.25 * (LIGHT[:, None] * body.shape.normal(point)).sum(0)
            light[:, here] = body.colour(point, BLUR / camera.pinhole[0] * t[here]) * shade
    return light.T.reshape(camera.height, camera.width, 3)


def write_look_alikes(name: str, seed: int, folder: Path) -> None:
    """Render a case of ``LOOK_ALIKES``: ``images`` and, as a COLMAP model, ``sparse_gt``."""
    # This runs in a separate process, because cv2 and pycolmap conflict.
    from PIL import Image

    from pipeline.demo.render import rays
    from pipeline.demo.sensor import srgb, to_bytes
    from pipeline.io.colmap import write_model

    video = name.endswith("_video")
    world = _world(name.removesuffix("_video"), seed)
    rng = np.random.default_rng([seed, 9, video])
    count = FRAMES if video else PHOTOGRAPHS
    order = np.arange(count) if video else rng.permutation(count)
    kind = "frame" if video else "photo"
    poses = _poses(world.path, count, video, rng)
    views = [replace(p, name=f"{kind}_{n:04d}.png") for p, n in zip(poses, order, strict=True)]
    camera = lens("simple_radial", WIDTH, HEIGHT)
    flat = rays(camera).centres.reshape(3, -1)
    (folder / "images").mkdir(parents=True)
    for posed in views:
        light = _picture(posed, camera, flat, world.bodies)
        noisy = srgb(light) + rng.normal(0, NOISE, light.shape)
        Image.fromarray(to_bytes(noisy)).save(folder / "images" / posed.name, compress_level=1)
    truth = Reconstruction({1: camera}, {i + 1: posed for i, posed in enumerate(views)})
    write_model(folder / "sparse_gt", truth, text=True)
