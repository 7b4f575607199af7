"""How far a view of the trained scene is to be trusted, point by point."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from pipeline.coverage.probe_views import Eye, Floats, Points, Sighting, look_for, points_of

#: Pixels of the asking camera by which a point that nothing has measured may be off.
UNKNOWN_PIXELS = 50.0
#: The displacement, squared, that halves the trust; pixels. A point that one photograph shows, from
#: the very place that asks, is off by as much.
HALF_SQUARED = 2.0
#: 1 minus the cosine of the angle to the nearest photograph that halves the trust: of 30 degrees.
HALF_TURN = 0.134
#: What is trusted less is little trusted.
LITTLE = 0.5


@dataclass
class Evidence:
    """What photographs say of points, summed up.

    Attributes:
        count: (N,) photographs that see the point.
        passed: (N,) photographs that see past it, to something behind.
        first: (N, 3) unit vectors to the first photograph that sees it; 0 without one.
        aside: (N,) least cosine of the angle between there and another one that sees it.
        information: (6, N) xx, yy, zz, xy, xz, yz of the sum over those that see it of
            s^2 (1 - d d^T), with d the direction to the photograph and s its sharpness over the
            asking camera's.
        support: (N,) largest of min(1, s) / (1 + (1 - cos b) / HALF_TURN), with b the angle between
            the photograph and the asking camera.
    """

    count: Floats
    passed: Floats
    first: Floats
    aside: Floats
    information: Floats
    support: Floats

    @staticmethod
    def none(number: int) -> Evidence:
        count, passed, support = np.zeros((3, number), np.float32)
        first, information = np.zeros((number, 3), np.float32), np.zeros((6, number), np.float32)
        return Evidence(count, passed, first, np.ones_like(count), information, support)

    @property
    def parallax(self) -> Floats:
        """(N,) degrees between the first photograph that sees the point and the one farthest from
        that: at least half of the widest angle between two."""
        return np.asarray(np.degrees(np.arccos(self.aside)))

    def add(self, sighting: Sighting, points: Points) -> None:
        """One more photograph."""
        seen, d = sighting.seen, sighting.towards
        self.passed += sighting.passed
        self.information[:, seen], self.support[seen] = self.gained(sighting, points)
        new = self.count[seen] == 0
        self.first[seen[new]] = d[new]
        self.aside[seen] = np.minimum(self.aside[seen], _cosine(d, self.first[seen]))
        self.count[seen] += 1

    def gained(self, sighting: Sighting, points: Points) -> tuple[Floats, Floats]:
        """``information`` and ``support`` of the points that a photograph sees, with it."""
        seen, d = sighting.seen, sighting.towards
        s = sighting.sharpness / points.sharpness[seen]
        x, y, z = d.T
        grown = np.stack([1 - x * x, 1 - y * y, 1 - z * z, -x * y, -x * z, -y * z]) * (s * s)
        turn = (1 - _cosine(d, points.towards[seen])) / np.float32(HALF_TURN)
        support = np.minimum(s, 1) / (1 + turn)
        return self.information[:, seen] + grown, np.maximum(self.support[seen], support)


def gather(eyes: Iterable[Eye], points: Points) -> Evidence:
    """All that photographs say of points."""
    evidence = Evidence.none(len(points))
    for eye in eyes:
        evidence.add(look_for(eye, points.xyz, points.open), points)
    return evidence


def trust(information: Floats, support: Floats, towards: Floats) -> Floats:
    """(N,) in [0, 1]: precision * support.

    precision = 1 / (1 + e^2 / HALF_SQUARED): e, in pixels of the asking camera, is how far the
    point may be off across its ray, if each photograph finds it with an error of one pixel. It
    comes of the covariance C of a triangulated point, the inverse of the information (each
    photograph weighs by its pixels in a world unit and knows nothing along its ray) plus a prior
    of UNKNOWN_PIXELS: e^2 = tr C - d^T C d, d being the direction to the asking camera. So an
    unknown depth costs nothing seen from where the photographs stand, and much from the side.
    Source of the covariance: Hartley and Zisserman, Multiple View Geometry, chapter 5.

    support = max over the photographs that see the point of
    min(1, s) / (1 + (1 - cos b) / HALF_TURN): its colour was seen from a direction near enough (b:
    the angle to the asking camera), and sharply enough (s: the photograph's pixels in a world unit
    over the asking camera's).

    Args:
        information, support: of ``Evidence``. towards: (N, 3) unit vectors to the asking cameras.
    """
    prior = np.float32(UNKNOWN_PIXELS**-2)
    xx, yy, zz = information[:3] + prior
    xy, xz, yz = information[3:]
    # The adjugate: the inverse times the determinant.
    a, b, c = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    d, e, f = xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz
    determinant = xx * a + xy * d + xz * e
    x, y, z = towards.T
    along = a * x * x + b * y * y + c * z * z + 2 * (d * x * y + e * x * z + f * y * z)
    squared = np.maximum(a + b + c - along, 0) / np.maximum(determinant, np.float32(1e-30))
    return np.asarray(support / (1 + squared / np.float32(HALF_SQUARED)))


def trust_picture(eye: Eye, photographs: Iterable[Eye], beyond: float) -> tuple[Floats, Evidence]:
    """(H, W) trust of each pixel of what a camera shows, and what it rests on, row by row.

    Args:
        beyond: depth to take where a ray meets no surface, world unit.
    """
    points = points_of(eye, beyond)
    evidence = gather(photographs, points)
    found = trust(evidence.information, evidence.support, points.towards)
    return found.reshape(eye.depth.shape), evidence


def trust_pictures(
    eyes: Sequence[Eye], photographs: Sequence[Eye], beyond: float, threads: int
) -> Iterator[tuple[Floats, Evidence]]:
    """``trust_picture`` of each camera in order, ``threads`` at a time."""
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        yield from pool.map(lambda eye: trust_picture(eye, photographs, beyond), eyes)


def _cosine(a: Floats, b: Floats) -> Floats:
    """(N,) of the angles between unit vectors."""
    product = a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]
    return np.asarray(product.clip(-1, 1))
