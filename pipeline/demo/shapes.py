"""Shapes for ray tracing. Points and directions are (3, N) float64, world frame, z up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Nearer hits are self-intersections with the surface at the origin of the ray.
NEAR = 1e-4


class Shape(Protocol):
    def hit(self, origin: Array, direction: Array) -> Array:
        """(N,) smallest t > NEAR with origin + t * direction on the surface, inf where none is.

        ``origin`` is (3, 1) or (3, N); directions need not be unit vectors.
        """
        ...

    def normal(self, point: Array) -> Array:
        """(3, N) unit normals, outwards, at points on the surface."""
        ...

    def distance(self, point: Array) -> Array:
        """(N,) exact signed distances, negative inside solids."""
        ...


@dataclass(frozen=True)
class Sphere:
    centre: tuple[float, float, float]
    radius: float

    def hit(self, origin: Array, direction: Array) -> Array:
        offset = origin - np.array(self.centre)[:, None]
        return _quadratic(
            (direction**2).sum(0),
            (direction * offset).sum(0),
            (offset**2).sum(0) - self.radius**2,
        )[0]

    def normal(self, point: Array) -> Array:
        return np.asarray((point - np.array(self.centre)[:, None]) / self.radius)

    def distance(self, point: Array) -> Array:
        offset = point - np.array(self.centre)[:, None]
        return np.asarray(np.sqrt((offset**2).sum(0)) - self.radius)


@dataclass(frozen=True)
class Cylinder:
    """A vertical cylinder with both caps."""

    centre: tuple[float, float]
    radius: float
    bottom: float
    top: float

    def hit(self, origin: Array, direction: Array) -> Array:
        offset = origin[:2] - np.array(self.centre)[:, None]
        flat = direction[:2]
        first, _ = _quadratic(
            (flat**2).sum(0), (flat * offset).sum(0), (offset**2).sum(0) - self.radius**2
        )
        z = origin[2] + np.where(np.isfinite(first), first, 0) * direction[2]
        best = np.where((z >= self.bottom) & (z <= self.top), first, np.inf)
        for height in (self.bottom, self.top):
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (height - origin[2]) / direction[2]
            t = np.where(np.isfinite(t), t, 0.0)
            x, y = offset[0] + t * flat[0], offset[1] + t * flat[1]
            good = (t > NEAR) & (x * x + y * y <= self.radius**2)
            best = np.where(good, np.minimum(best, t), best)
        return best

    def normal(self, point: Array) -> Array:
        x, y = (point[:2] - np.array(self.centre)[:, None]) / self.radius
        on_cap = np.minimum(self.top - point[2], point[2] - self.bottom) < 1e-9
        up = np.where(point[2] > (self.top + self.bottom) / 2, 1.0, -1.0)
        return np.stack([np.where(on_cap, 0, x), np.where(on_cap, 0, y), np.where(on_cap, up, 0)])

    def distance(self, point: Array) -> Array:
        flat = np.hypot(*(point[:2] - np.array(self.centre)[:, None])) - self.radius
        return _outside(np.stack([flat, np.maximum(self.bottom - point[2], point[2] - self.top)]))


@dataclass(frozen=True)
class Box:
    """A box, rotated by ``yaw`` radians about the vertical; with ``inside``, a room from within."""

    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    yaw: float = 0.0
    inside: bool = False

    def _local(self, vector: Array) -> Array:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.stack([c * vector[0] + s * vector[1], c * vector[1] - s * vector[0], vector[2]])

    def hit(self, origin: Array, direction: Array) -> Array:
        start = self._local(origin - np.array(self.centre)[:, None])
        along = self._local(direction)
        half = np.array(self.half)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):  # Rays along a face give inf or miss.
            a, b = (-half - start) / along, (half - start) / along
        enter, leave = np.minimum(a, b).max(0), np.maximum(a, b).min(0)
        t = leave if self.inside else enter
        return np.where((enter < leave) & (t > NEAR), t, np.inf)

    def normal(self, point: Array) -> Array:
        local = self._local(point - np.array(self.centre)[:, None])
        share = local / np.array(self.half)[:, None]
        axis = np.abs(share).argmax(0)
        n = np.where(np.arange(3)[:, None] == axis, np.sign(share), 0.0)
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        turned = np.stack([c * n[0] - s * n[1], s * n[0] + c * n[1], n[2]])
        return -turned if self.inside else turned

    def distance(self, point: Array) -> Array:
        local = self._local(point - np.array(self.centre)[:, None])
        signed = _outside(np.abs(local) - np.array(self.half)[:, None])
        return -signed if self.inside else signed


def _outside(excess: Array) -> Array:
    """The signed distance of a body from the (K, N) signed distances of its perpendicular faces."""
    beyond = np.sqrt((np.maximum(excess, 0) ** 2).sum(0))
    return np.asarray(beyond + np.minimum(excess.max(0), 0))


def _quadratic(a: Array, half_b: Array, c: Array) -> tuple[Array, Array]:
    """Both roots of a t^2 + 2 half_b t + c beyond NEAR, nearer first; inf where there is none."""
    inner = half_b**2 - a * c
    root = np.sqrt(np.maximum(inner, 0.0))
    low, high = (-half_b - root) / a, (-half_b + root) / a
    low = np.where((inner > 0) & (low > NEAR), low, np.inf)
    high = np.where((inner > 0) & (high > NEAR), high, np.inf)
    return np.minimum(low, high), high
