"""The ground of the town: roads with their markings, pavements, gardens, and shadows on all of it.

What has sharp edges (roads, kerbs, markings, slabs) is computed from the position; shadows, paths
and the town's outline come from a map of the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.town.layout import LENGTH, ROAD, STREET, WIDTH, Town
from benchmarks.town.noise import TILE_SIGMA, periodic_tile
from benchmarks.town.pyramids import Pyramid, pyramid
from benchmarks.town.solids import Ellipsoid, Solid

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

# The direction towards the sun.
SUN = np.array([-0.48, -0.55, 0.683]) / np.linalg.norm([-0.48, -0.55, 0.683])
SUNLIGHT = np.array([0.86, 0.79, 0.69], np.float32)
SKYLIGHT = np.array([0.36, 0.40, 0.46], np.float32)
MAP_TEXEL = 0.1  # metres; larger for towns of kilometres
MAX_MAP_SIDE = 16_000
BORDER = 12.0  # metres of the map around the town
# Tiles of noise at different scales and angles: together they do not repeat within any town.
LAYERS = ((0.013, 0.4), (0.029, 1.3), (0.17, 2.2))  # metres per texel, radians


@dataclass(frozen=True)
class Ground:
    """The ground's appearance.

    Attributes:
        map: The shares of sun, sky, paving and town at each place, of 255.
        corner: The map's lower left corner, (2,), metres.
        texel: The map's resolution, metres.
        noise: The periodic tile.
    """

    map: Pyramid
    corner: Array
    texel: float
    noise: Pyramid

    def albedo_and_light(self, x: Floats, y: Floats, blur: Floats) -> tuple[Floats, Floats]:
        """The (N, 3) albedo and irradiance at positions; ``blur`` is the (N,) width of the texture
        filter, metres."""
        level = np.log2(np.maximum(blur / np.float32(self.texel), 1e-3))
        u = (x - np.float32(self.corner[0])) / np.float32(self.texel)
        v = (y - np.float32(self.corner[1])) / np.float32(self.texel)
        sun, sky, paving, town = (self.map.sample(u, v, level) * np.float32(1 / 255)).T
        layers = [self._layer(x, y, blur, *layer) for layer in LAYERS]
        albedo = _meadow(layers)
        albedo += paving[:, None] * (_paving(x, y, blur, layers) - albedo)
        _lay(albedo, town, _street(x, y, blur, layers))
        light = sun[:, None] * (SUNLIGHT * np.float32(SUN[2])) + sky[:, None] * SKYLIGHT
        return albedo, light

    def _layer(self, x: Floats, y: Floats, blur: Floats, texel: float, angle: float) -> Floats:
        """Noise of unit deviation, (N, 4)."""
        c, s = np.float32(np.cos(angle) / texel), np.float32(np.sin(angle) / texel)
        level = np.log2(np.maximum(blur / np.float32(texel), 1e-3))
        values = self.noise.sample(c * x + s * y, c * y - s * x, level)
        values -= np.float32(128)
        values *= np.float32(1 / TILE_SIGMA)
        return values


def ground_of(town: Town) -> Ground:
    """The ground under a town."""
    cells = np.array(town.cells, np.float64)
    low = cells.min(0) * (LENGTH, WIDTH) - (STREET, WIDTH / 2) - BORDER
    high = cells.max(0) * (LENGTH, WIDTH) + (LENGTH + STREET, WIDTH / 2) + BORDER
    texel = max(MAP_TEXEL, float((high - low).max()) / MAX_MAP_SIDE)
    columns, rows = (int(n) for n in np.ceil((high - low) / texel))
    names = ("sun", "base", "paved", "town")
    layers = {name: np.zeros((rows, columns), np.uint8) for name in names}

    def draw(name: str, polygon: Array) -> None:
        points = np.rint((polygon - low) / texel * 16).astype(np.int32)
        cv2.fillConvexPoly(layers[name], points, 255, cv2.LINE_AA, 4)

    for solid in town.solids:
        corners = _outline(solid)
        draw("sun", _hull(corners[:, :2] - corners[:, 2:] * (SUN[:2] / SUN[2])))
        if corners[:, 2].min() < 0.5:
            draw("base", _hull(corners[:, :2]))
    for polygon in town.paved:
        draw("paved", polygon)
    for x, y in cells * (LENGTH, WIDTH):
        a, b, c = x - STREET, x + LENGTH + STREET, WIDTH / 2
        draw("town", np.array([[a, y - c], [b, y - c], [b, y + c], [a, y + c]]))
    sun = cv2.GaussianBlur(layers["sun"], (0, 0), 0.7)
    # A fraction of the sky is hidden at the foot of what stands on the ground.
    base = cv2.GaussianBlur(layers["base"], (0, 0), 0.6 / texel)
    image = np.stack([255 - sun, 255 - 0.55 * base, layers["paved"], layers["town"]], axis=-1)
    tile = pyramid(np.asarray(periodic_tile(), np.float32), periodic=True)
    return Ground(pyramid(image.astype(np.float32)), low, texel, tile)


def _outline(solid: Solid) -> Array:
    """Points whose convex hull has about the solid's shadow, (N, 3)."""
    if not isinstance(solid, Ellipsoid):
        return solid.vertices
    i = np.arange(80)
    z = 1 - (2 * i + 1) / len(i)
    angle = i * np.pi * (3 - np.sqrt(5))
    flat = np.sqrt(1 - z**2)
    sphere = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
    points = np.array(solid.centre) + sphere * np.array(solid.radii)
    return np.maximum(points, (-np.inf, -np.inf, 0.0))


def _hull(points: Array) -> Array:
    return np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], np.float64)


def _mix(layers: list[Floats], channel: int, fine: float, middle: float, coarse: float) -> Floats:
    total = np.float32(fine) * layers[0][:, channel]
    total += np.float32(middle) * layers[1][:, channel]
    total += np.float32(coarse) * layers[2][:, channel]
    return total


def _tinted(colour: tuple[float, float, float], factor: Floats) -> Floats:
    return np.maximum(factor, np.float32(0.25))[:, None] * np.array(colour, np.float32)


def _lay(albedo: Floats, share: Floats, layer: tuple[Floats, Floats]) -> None:
    """Cover the albedo with (N, 3) colours by (N,) shares, in place."""
    colour, cover = layer
    albedo += (share * cover)[:, None] * (colour - albedo)


def _meadow(layers: list[Floats]) -> Floats:
    grass = _tinted((0.10, 0.16, 0.045), 1 + _mix(layers, 0, 0.22, 0.2, 0.16))
    dry = np.clip(_mix(layers, 1, 0.1, 0.4, 0.6) - np.float32(0.5), 0, np.float32(0.8))
    grass += dry[:, None] * (np.array([0.26, 0.22, 0.11], np.float32) - grass)
    return grass


def _edge(inside: Floats, blur: Floats) -> Floats:
    """Return 1 where ``inside`` is positive, else 0, with an edge as wide as the filter."""
    return np.clip(inside / np.maximum(blur, np.float32(0.01)) + np.float32(0.5), 0, 1)


def _joints(x: Floats, y: Floats, blur: Floats, size: float) -> tuple[Floats, Floats]:
    """The share of joints between square slabs, and a tint of each slab of about unit deviation."""
    u, v = x / np.float32(size), y / np.float32(size)
    i, j = np.floor(u), np.floor(v)
    near = np.minimum(np.minimum(u - i, i + 1 - u), np.minimum(v - j, j + 1 - v))
    joint = _edge(np.float32(0.012) - near * np.float32(size), blur)
    fade = np.clip(np.float32(size) / (2 * blur) - 1, 0, 1)
    # A table of random numbers; its sides have no common divisor, so that it does not repeat soon.
    table = _SLABS[(i.astype(np.intp) * 37 + j.astype(np.intp) * 101) % len(_SLABS)]
    # Fine joints that the filter does not resolve darken the whole.
    return joint * fade, table * fade


_SLABS = np.random.default_rng(31).normal(0, 1, 8191).astype(np.float32)


def _paving(x: Floats, y: Floats, blur: Floats, layers: list[Floats]) -> Floats:
    joint, tint = _joints(x, y, blur, 0.4)
    factor = 1 + np.float32(0.13) * tint + _mix(layers, 2, 0.09, 0.1, 0.06)
    return _tinted((0.40, 0.36, 0.31), factor * (1 - np.float32(0.5) * joint))


def _street(x: Floats, y: Floats, blur: Floats, layers: list[Floats]) -> tuple[Floats, Floats]:
    """The colours of the street's surface, and its share of the ground."""
    length, width = np.float32(LENGTH), np.float32(WIDTH)
    across = np.abs(y - np.round(y / width) * width)
    along = x - np.floor(x / length) * length
    side = np.minimum(along, length - along)  # from the middle of the cross street
    nearest = np.minimum(across, side)
    street = _edge(np.float32(STREET) - nearest, blur)
    road = _edge(np.float32(ROAD) - nearest, blur)
    joint, tint = _joints(x, y, blur, 0.6)
    factor = 1 + np.float32(0.12) * tint + _mix(layers, 3, 0.08, 0.1, 0.08)
    colour = _tinted((0.34, 0.33, 0.32), factor * (1 - np.float32(0.5) * joint))
    kerb = _edge(np.float32(ROAD + 0.14) - nearest, blur)
    colour += kerb[:, None] * (_tinted((0.50, 0.49, 0.46), factor) - colour)
    asphalt = _asphalt(layers)
    _mark(asphalt, along, across, side, blur, layers)
    colour += road[:, None] * (asphalt - colour)
    return colour, street


def _asphalt(layers: list[Floats]) -> Floats:
    colour = _tinted((0.155, 0.155, 0.16), 1 + _mix(layers, 0, 0.2, 0.11, 0.06))
    repaired = np.clip((layers[2][:, 1] - np.float32(1.4)) * 6, 0, np.float32(0.5))
    crack = np.abs(_mix(layers, 2, 0.05, 0.2, 1.0))
    dark = np.clip(1 - crack * 40, 0, np.float32(0.6))
    dark *= np.clip(layers[2][:, 3] * 3 - 1, 0, 1)
    colour *= ((1 - np.float32(0.5) * repaired) * (1 - dark))[:, None]
    return colour


def _mark(
    colour: Floats, along: Floats, across: Floats, side: Floats, blur: Floats, layers: list[Floats]
) -> None:
    """Paint a dashed middle line and zebra crossings, worn in places; in place."""
    phase = along - np.floor(along / 4) * 4
    dash = _edge(np.float32(0.07) - across, blur) * _edge(1 - np.abs(phase - 2), blur)
    dash *= _edge(side - np.float32(9.5), blur)
    bars = across - np.floor(across / np.float32(1.0)) * np.float32(1.0)
    zebra = _edge(np.float32(0.25) - np.abs(bars - np.float32(0.5)), blur)
    zebra *= _edge(np.float32(1.3) - np.abs(side - np.float32(7.2)), blur)
    worn = np.clip(np.float32(0.9) - _mix(layers, 3, 0.2, 0.25, 0.25), 0, np.float32(0.92))
    cover = np.maximum(dash, zebra) * worn
    colour += cover[:, None] * (np.array([0.62, 0.62, 0.59], np.float32) - colour)
