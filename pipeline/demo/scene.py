"""The demo scene: a textured room with a few objects in the middle, and its lighting.

World frame: z up, the floor at 0, metres. All light is linear, sRGB primaries.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from pipeline.demo.lighting import Colour, Light
from pipeline.demo.shapes import Box, Cylinder, Shape, Sphere
from pipeline.demo.textures import Material

Array = NDArray[np.float64]

ROOM = Box((0, 0, 1.5), (3.5, 3.5, 1.5), inside=True)
LAMPS = np.array([[1.2, -0.9, 2.8], [-1.6, 1.2, 2.6]])
LAMP_SIZE = 0.5  # Half the side of each lamp's panel; larger panels give softer shadows.
LAMP_SAMPLES = 6  # Samples per side of the grid over a panel.
SKY_SAMPLES = 48
# Shadows come from a precomputed map of the middle of the floor; outside it there are none.
SHADOW_REACH = 2.0
SHADOW_CELLS = 134

# Floor, walls and ceiling have coarser textures than the objects: they are farther away.
FLOOR = Material((0.42, 0.33, 0.24), (0.25, 0.17, 0.10), (-0.07, 0.03, 0.10), 0.08, 0.9, 1)
WALLS = Material((0.40, 0.44, 0.42), (0.16, 0.22, 0.25), (0.20, 0.02, -0.12), 0.14, 1.4, 2)
CEILING = Material((0.55, 0.55, 0.58), (0.18, 0.18, 0.20), (0.06, -0.04, 0.06), 0.18, 1.6, 3)


@dataclass(frozen=True)
class SceneObject:
    """An object of the scene."""

    shape: Shape
    material: Material


OBJECTS: tuple[SceneObject, ...] = (
    SceneObject(
        Cylinder((0.0, 0.0), 0.42, 0.0, 0.38),
        Material((0.36, 0.37, 0.42), (0.26, 0.25, 0.22), (0.12, -0.04, -0.12), 0.04, 0.4, 11),
    ),
    SceneObject(
        Sphere((0.0, 0.0, 0.68), 0.30),
        Material((0.34, 0.07, 0.06), (0.22, 0.10, 0.03), (0.08, 0.07, 0.10), 0.05, 0.4, 12, 0.05),
    ),
    SceneObject(
        Box((0.95, 0.25, 0.28), (0.22, 0.30, 0.28), 0.4),
        Material((0.16, 0.30, 0.42), (0.14, 0.24, 0.26), (0.20, 0.12, -0.10), 0.04, 0.4, 13),
    ),
    SceneObject(
        Box((0.95, 0.25, 0.68), (0.13, 0.11, 0.12), 0.9),
        Material((0.48, 0.36, 0.10), (0.32, 0.20, 0.06), (-0.10, 0.08, 0.14), 0.04, 0.3, 14),
    ),
    SceneObject(
        Box((-0.55, 0.85, 0.42), (0.30, 0.18, 0.42), -0.5),
        Material((0.22, 0.36, 0.16), (0.18, 0.28, 0.12), (0.20, 0.06, 0.14), 0.04, 0.4, 15),
    ),
    SceneObject(
        Cylinder((-0.90, -0.45), 0.20, 0.0, 0.75),
        Material((0.44, 0.28, 0.36), (0.32, 0.18, 0.22), (-0.12, 0.12, 0.14), 0.04, 0.4, 16),
    ),
    SceneObject(
        Sphere((0.15, -0.95, 0.27), 0.27),
        Material((0.42, 0.42, 0.38), (0.36, 0.34, 0.26), (-0.08, 0.04, 0.18), 0.04, 0.4, 17),
    ),
    SceneObject(
        Sphere((-0.40, -0.85, 0.13), 0.13),
        Material((0.48, 0.22, 0.08), (0.30, 0.18, 0.06), (-0.06, 0.08, 0.16), 0.04, 0.3, 18),
    ),
)
# The material of the moving object in scenes with masks; its position differs in each image.
VISITOR = Material((0.30, 0.08, 0.40), (0.10, 0.06, 0.14), (0.20, 0.14, -0.10), 0.04, 0.3, 19)

UP = np.array([[0.0], [0.0], [1.0]])
BACKGROUND = -1


def trace(
    origin: Array, direction: Array, objects: tuple[SceneObject, ...]
) -> tuple[Array, NDArray]:
    """The first hits of rays from (3, 1) or (3, N) origins: (N,) t, and (N,) index of the object or
    BACKGROUND for the room."""
    best = ROOM.hit(origin, direction)
    index = np.full(best.shape, BACKGROUND)
    for i, item in enumerate(objects):
        t = item.shape.hit(origin, direction)
        nearer = t < best
        best, index = np.where(nearer, t, best), np.where(nearer, i, index)
    return best, index


def distance(point: Array) -> Array:
    """(N,) signed distances of (3, N) points from the scene's surface; positive in
    the empty part of the room."""
    shapes = (ROOM, *(item.shape for item in OBJECTS))
    return np.asarray(np.min([shape.distance(point) for shape in shapes], axis=0))


def shade(
    origin: Array,
    direction: Array,
    t: Array,
    index: NDArray,
    blur: Array,
    objects: tuple[SceneObject, ...],
    lit: Light,
) -> Array:
    """(3, N) linear radiance along rays with hits at ``t``, in the light ``lit``.

    Args:
        blur: (N,) sigmas of the texture filter at the hits in metres.
    """
    light = np.zeros(direction.shape)
    point = origin + t * direction
    for i in range(BACKGROUND, len(objects)):
        here = np.flatnonzero(index == i)
        if len(here) == 0:
            continue
        p, s = point[:, here], blur[here]
        if i == BACKGROUND:
            light[:, here] = _room_light(p, s, lit)
            continue
        normal = objects[i].shape.normal(p)
        material = objects[i].material
        # Near the floor, a part of the ambient light is occluded.
        open_share = 0.72 + 0.28 * np.clip(p[2] / 0.25, 0, 1)
        colour = _albedo(material, p, s) * _irradiance(p, normal, lit) * open_share
        if material.gloss > 0:
            colour = 0.9 * colour + _reflection(material, direction[:, here], p, normal, lit)
        light[:, here] = colour
    return light


def _albedo(material: Material, point: Array, blur: Array) -> Array:
    return material.albedo(point.astype(np.float32), blur.astype(np.float32)).astype(np.float64)


def _irradiance(point: Array, normal: Array, lit: Light) -> Array:
    """(3, N) light on a matte surface: without shadows but those of the sun."""
    total = _column(lit.sky) * (0.8 + 0.2 * normal[2])
    for lamp, power in zip(LAMPS, lit.lamps, strict=True):
        total = total + _lamp_light(lamp, power, point, normal)
    return _with_sun_and_clouds(total, point, normal, lit)


def _lamp_light(lamp: Array, power: Colour, point: Array, normal: Array) -> Array:
    to_lamp = lamp[:, None] - point
    distance2 = (to_lamp**2).sum(0)
    cosine = np.maximum((to_lamp * normal).sum(0), 0) / np.sqrt(distance2)
    return np.asarray(_column(power) * cosine / (0.5 + 0.12 * distance2))


def _with_sun_and_clouds(total: Array, point: Array, normal: Array, lit: Light) -> Array:
    """(3, N) light with that of the sun, whose shadows are those of the objects, dimmed by
    clouds."""
    if lit.sun is not None:
        towards = _column(lit.towards_sun)
        faces = np.flatnonzero((towards * normal).sum(0) > 0)
        cosine = np.zeros(point.shape[1])
        cosine[faces] = (towards * normal[:, faces]).sum(0)
        cosine[faces] *= _is_open(point[:, faces], towards + 0 * point[:, faces])
        total = total + _column(lit.sun) * cosine
    return total if lit.clouds is None else total * lit.clouds.share(point)


def _column(colour: Colour) -> Array:
    return np.array(colour)[:, None]


def _room_light(point: Array, blur: Array, lit: Light) -> Array:
    normal = ROOM.normal(point)
    light = np.zeros(point.shape)
    floor, ceiling = normal[2] > 0.5, normal[2] < -0.5
    for material, where in (
        (FLOOR, floor),
        (CEILING, ceiling),
        (WALLS, ~(floor | ceiling)),
    ):
        here = np.flatnonzero(where)
        p = point[:, here]
        if material is FLOOR:
            irradiance = _floor_irradiance(p, lit)
        else:
            irradiance = _irradiance(p, normal[:, here], lit)
        light[:, here] = _albedo(material, p, blur[here]) * irradiance
    return light


def _reflection(
    material: Material, direction: Array, point: Array, normal: Array, lit: Light
) -> Array:
    """Mild gloss: the room as a blurred mirror (Schlick's Fresnel) and the lamps' highlights."""
    view = direction / np.linalg.norm(direction, axis=0)
    cosine = -(view * normal).sum(0)
    mirrored = view + 2 * cosine * normal
    fresnel = material.gloss + (0.5 - material.gloss) * (1 - np.clip(cosine, 0, 1)) ** 5
    t = ROOM.hit(point, mirrored)
    light = fresnel * _room_light(point + t * mirrored, np.full(t.shape, 0.2), lit)
    for lamp, power in zip(LAMPS, lit.lamps, strict=True):
        to_lamp = lamp[:, None] - point
        to_lamp = to_lamp / np.linalg.norm(to_lamp, axis=0)
        light = light + 0.6 * _column(power) * np.maximum((to_lamp * mirrored).sum(0), 0) ** 30
    return np.asarray(light)


def _floor_irradiance(point: Array, lit: Light) -> Array:
    """The light on (3, N) points of the floor as in ``_irradiance``, with the soft shadows of the
    lamps and the sky."""
    scale = (SHADOW_CELLS - 1) / 2
    u = np.clip((point[0] / SHADOW_REACH + 1) * scale, 0, SHADOW_CELLS - 1.001)
    v = np.clip((point[1] / SHADOW_REACH + 1) * scale, 0, SHADOW_CELLS - 1.001)
    i, j = u.astype(np.intp), v.astype(np.intp)
    a, b = u - i, v - j
    maps = shadow_maps()
    top = maps[:, j, i] * (1 - a) + maps[:, j, i + 1] * a
    bottom = maps[:, j + 1, i] * (1 - a) + maps[:, j + 1, i + 1] * a
    sky, *seen = top * (1 - b) + bottom * b
    total = _column(lit.sky) * sky
    for lamp, power, share in zip(LAMPS, lit.lamps, seen, strict=True):
        total = total + share * _lamp_light(lamp, power, point, UP)
    return _with_sun_and_clouds(total, point, UP + 0 * point, lit)


@cache
def shadow_maps() -> Array:
    """(1 + lamps, SHADOW_CELLS, SHADOW_CELLS) shares of the sky and of each lamp that are visible
    from points on the floor. They are computed once per process."""
    side = np.linspace(-SHADOW_REACH, SHADOW_REACH, SHADOW_CELLS)
    x, y = (v.ravel() for v in np.meshgrid(side, side))
    point = np.stack([x, y, np.zeros_like(x)])
    # Directions are spread evenly over a disc and lifted to the half sphere: Malley's method.
    angle = np.arange(SKY_SAMPLES) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt((np.arange(SKY_SAMPLES) + 0.5) / SKY_SAMPLES)
    sky = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)])
    maps = [np.mean([_is_open(point, d[:, None] + 0 * point) for d in sky.T], axis=0)]
    panel = LAMP_SIZE * (2 * (np.arange(LAMP_SAMPLES) + 0.5) / LAMP_SAMPLES - 1)
    for lamp in LAMPS:
        ends = [lamp + np.array([dx, dy, 0.0]) for dx in panel for dy in panel]
        maps.append(np.mean([_is_open(point, end[:, None] - point) for end in ends], axis=0))
    return np.stack(maps).reshape(-1, SHADOW_CELLS, SHADOW_CELLS)


def _is_open(point: Array, towards: Array) -> NDArray[np.bool_]:
    """True where no object lies between a point and the end of the vector, a lamp or the room."""
    return np.asarray(trace(point, towards, OBJECTS)[1] == BACKGROUND)
