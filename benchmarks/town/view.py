"""One view of the town: linear light and exact depth."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.town.finishes import TEXEL, painted
from benchmarks.town.ground import SKYLIGHT, SUN, SUNLIGHT, Ground, ground_of
from benchmarks.town.layout import Town
from benchmarks.town.noise import TILE_SIGMA
from benchmarks.town.pyramids import Pyramid, pyramid
from benchmarks.town.solids import Ellipsoid, Face
from benchmarks.town.visibility import GROUND, Grid, Hits, Shapes, visible
from pipeline.demo.render import TEXTURE_SIGMA, Rays, developed
from pipeline.geometry.cameras import Camera
from pipeline.scene.reconstruction import PosedImage

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

# The memory for painted textures, of each process.
TEXTURE_BYTES = 256 * 2**20
# The exponent of the foreshortening in the width of the texture filter: 1 avoids all aliasing and
# blurs along surfaces that are seen at a grazing angle, 0.5 is the mean of both directions.
FORESHORTENING = 0.75
HORIZON, ZENITH = (0.72, 0.78, 0.84), (0.26, 0.42, 0.68)
# The width of the filter in pixels: that of a Gaussian of sigma s is about 2 s.
FILTER_PX = 2 * TEXTURE_SIGMA
LEAF_TEXEL = 0.012


@dataclass
class Textures:
    """Textures of faces, painted when first seen; the least recently seen are dropped."""

    stored: OrderedDict[int, Pyramid] = field(default_factory=OrderedDict)
    num_bytes: int = 0

    def of(self, face: Face) -> Pyramid:
        """The texture, as square roots of albedo times 255."""
        key = id(face)
        if key in self.stored:
            self.stored.move_to_end(key)
            return self.stored[key]
        albedo = painted(face.finish, face.width, face.height)
        texture = self.stored[key] = pyramid(255 * np.sqrt(np.clip(albedo, 0.004, 0.9)))
        self.num_bytes += texture.num_bytes
        while self.num_bytes > TEXTURE_BYTES and len(self.stored) > 1:
            self.num_bytes -= self.stored.popitem(last=False)[1].num_bytes
        return texture


@dataclass(frozen=True)
class Capture:
    """A town and a lens, prepared for photographs.

    Attributes:
        fine, centres: The rays as in ``pipeline.demo.render.Rays``; ``fine`` in single precision.
        focal: The focal length, pixels.
    """

    shapes: Shapes
    ground: Ground
    textures: Textures
    fine: Grid
    centres: Grid
    focal: float
    width: int
    height: int


def capture(town: Town, camera: Camera, through: Rays) -> Capture:
    x, y = (np.ascontiguousarray(v, np.float32) for v in through.fine[:2])
    return Capture(
        Shapes.of(list(town.solids)),
        ground_of(town),
        Textures(),
        Grid(x, y),
        Grid(through.centres[0], through.centres[1]),
        float(camera.pinhole[0]),
        camera.width,
        camera.height,
    )


def photograph(town: Capture, posed: PosedImage) -> tuple[Array, Floats]:
    """The linear light, (H, W, 3), and float32 depth (z) at pixel centres, (H, W); 0 is sky."""
    light = _light(town, posed, visible(town.shapes, posed, town.fine))
    inverse = visible(town.shapes, posed, town.centres).inverse
    depth = np.divide(1.0, inverse, out=np.zeros_like(inverse), where=inverse > 0)
    return developed(light, town.width, town.height), depth.astype(np.float32)


def _light(town: Capture, posed: PosedImage, hits: Hits) -> Floats:
    """The linear light of the fine rays, (R, C, 3)."""
    light = np.empty((hits.label.size, 3), np.float32)
    labels = hits.label.ravel()
    order = np.argsort(labels, kind="stable")
    ends = np.searchsorted(labels[order], np.arange(len(hits.seen) + 3))
    x, y, inverse = town.fine.x.ravel(), town.fine.y.ravel(), hits.inverse.ravel()
    for label in range(len(hits.seen) + 2):
        where = order[ends[label] : ends[label + 1]]
        for start in range(0, len(where), 65_536):
            part = where[start : start + 65_536]
            rays = _Hit(posed, x[part], y[part], inverse[part], FILTER_PX / town.focal)
            if label < GROUND:
                light[part] = _sky(rays)
            elif label == GROUND:
                light[part] = _ground(town.ground, rays)
            else:
                solid, number = hits.seen[label - 2]
                if isinstance(solid, Ellipsoid):
                    light[part] = _leaves(town.ground.noise, solid, rays)
                else:
                    light[part] = _face(town.textures, solid.faces[number], rays)
    return light.reshape(*hits.label.shape, 3)


@dataclass(frozen=True)
class _Hit:
    """Hits of rays: (N,) ``x`` and ``y`` of the ray in the camera's frame, and inverse depths;
    ``pixel`` is the width of the texture filter at unit depth."""

    posed: PosedImage
    x: Floats
    y: Floats
    inverse: Floats
    pixel: float

    def along(self, axis: Array) -> Floats:
        """The component of the unnormalised rays along a vector of the world, (N,)."""
        a, b, c = (np.float32((axis * row).sum()) for row in self.posed.rotation)
        return np.asarray(a * self.x + b * self.y + c)

    def position(self, axis: Array, origin: Array) -> Floats:
        """The coordinate of the hits along a vector, from an origin, (N,)."""
        start = np.float32(((self.posed.centre - origin) * axis).sum())
        return np.asarray(start + self.along(axis) / self.inverse)

    def blur(self, normal: Array) -> Floats:
        """The width of the texture filter on a plane, (N,), metres."""
        steep = np.abs(self.along(normal)) / np.sqrt(1 + self.x**2 + self.y**2)
        wide = np.maximum(steep, np.float32(0.01)) ** np.float32(FORESHORTENING)
        return np.asarray(np.float32(self.pixel) / (self.inverse * wide))


def _sky(rays: _Hit) -> Floats:
    up = rays.along(np.array([0.0, 0.0, 1.0])) / np.sqrt(1 + rays.x**2 + rays.y**2)
    share = np.sqrt(np.clip(up, 0, 1))[:, None]
    low, high = (np.array(colour, np.float32) for colour in (HORIZON, ZENITH))
    return np.asarray(low + share * (high - low))


def _ground(ground: Ground, rays: _Hit) -> Floats:
    east, north = np.eye(3)[:2]
    x, y = rays.position(east, np.zeros(3)), rays.position(north, np.zeros(3))
    albedo, light = ground.albedo_and_light(x, y, rays.blur(np.array([0.0, 0.0, 1.0])))
    return albedo * light


def _irradiance(normal: Array) -> Floats:
    """The light on an unshadowed plane, (3,)."""
    direct = np.float32(max(0.0, float((normal * SUN).sum())))
    open_share = np.float32(0.72 + 0.28 * normal[2])
    return SUNLIGHT * direct + SKYLIGHT * open_share


def _face(textures: Textures, face: Face, rays: _Hit) -> Floats:
    texture, scale = textures.of(face), np.float32(1 / TEXEL)
    u = rays.position(face.right, face.origin) * scale
    v = rays.position(face.down, face.origin) * scale
    level = np.log2(np.maximum(rays.blur(face.normal) * scale, np.float32(1e-3)))
    roots = texture.sample(u, v, level)
    roots *= roots
    roots *= _irradiance(face.normal) * np.float32(1 / 255**2)
    return roots


def _leaves(noise: Pyramid, solid: Ellipsoid, rays: _Hit) -> Floats:
    """An ellipsoid of leaves: noise on the three coordinate planes, by the normal's direction."""
    centre, radii = np.array(solid.centre), np.array(solid.radii, np.float32)
    axes = np.eye(3)
    point = np.stack([rays.position(axis, centre) for axis in axes])
    normal = point / (radii**2)[:, None]
    normal /= np.sqrt((normal**2).sum(0))
    major = np.abs(normal).argmax(0)
    across = np.where(major == 0, point[1], point[0])
    along = np.where(major == 2, point[1], point[2])
    shift = np.float32(solid.seed % 1000) + major.astype(np.float32) * 300
    blur = np.float32(rays.pixel) / rays.inverse
    scale = np.float32(1 / LEAF_TEXEL)
    fine, coarse = (
        noise.sample(
            (across + shift) * scale * size,
            (along + shift * np.float32(0.7)) * scale * size,
            np.log2(np.maximum(blur * scale * size, np.float32(1e-3))),
        )
        for size in (np.float32(1), np.float32(0.37))
    )
    leaf = (fine[:, 0] + coarse[:, 1] - 256) / np.float32(TILE_SIGMA)
    tint = (coarse[:, 2] - 128) / np.float32(TILE_SIGMA)
    colour = np.array(solid.colour, np.float32) * np.maximum(1 + 0.42 * leaf, 0.15)[:, None]
    colour[:, 0] *= 1 + np.float32(0.15) * tint
    direct = np.maximum((normal * SUN.astype(np.float32)[:, None]).sum(0), 0)
    sky = 0.62 + 0.38 * normal[2]
    return np.asarray(colour * (direct[:, None] * SUNLIGHT + sky[:, None] * SKYLIGHT) * 1.15)
