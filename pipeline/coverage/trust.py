"""Trust: a number in [0, 1] for each pixel of a view, from how the photographs observe the pixel's
surface point. It does not use the photograph of the view itself.

trust = precision * support, with

precision = 1 / (1 + e^2 / HALF_TRUST_ERROR_SQUARED). e is the standard deviation, in pixels of the
query camera and across its ray, of the point triangulated from the photographs that see it with an
error of one pixel each. The covariance C of the point is the inverse of the information matrix:
each photograph adds s^2 (I - d d^T), with d the unit vector to the photograph and s its resolution
at the point over the query camera's, and the prior adds I / PRIOR_SIGMA_PX^2. With d_q the unit
vector to the query camera, e^2 = tr C - d_q^T C d_q. An uncertain depth hence lowers the trust of
views from the side, not of views from the photographs' own direction.
(Hartley and Zisserman, Multiple View Geometry, chapter 5.)

support = max over the photographs that see the point of
min(1, s) / (1 + (1 - cos b) / HALF_SUPPORT_TURN), with b the angle between the photograph and the
query camera at the point: the colour was observed from a similar direction, at sufficient
resolution.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from pipeline.coverage.probe_views import (
    Floats,
    ProbeView,
    QueryPoints,
    Visibility,
    backproject,
    find_visible,
)

#: Prior standard deviation of a point's position, pixels of the query camera.
PRIOR_SIGMA_PX = 50.0
#: e^2 at which precision is 1/2, pixels squared: that of a point seen by one photograph, from the
#: direction of the query camera and at its resolution.
HALF_TRUST_ERROR_SQUARED = 2.0
#: 1 - cos b at which support is 1/2; b is 30 degrees.
HALF_SUPPORT_TURN = 0.134
#: Pixels below this are counted as ``low_trust_share``.
LOW_TRUST = 0.5


@dataclass
class Observations:
    """How photographs observe points, accumulated photograph by photograph.

    Attributes:
        count: (N,) number of photographs that see the point.
        seen_past: (N,) number of photographs that see a surface, or none, behind the point.
        first_direction: (N, 3) unit vectors to the first photograph that sees the point; 0 if there
            is none.
        min_cosine: (N,) least cosine of the angle between ``first_direction`` and the direction to
            another photograph that sees the point.
        information: (6, N) xx, yy, zz, xy, xz, yz of the information matrix, without the prior.
        support: (N,) support, as defined above.
    """

    count: Floats
    seen_past: Floats
    first_direction: Floats
    min_cosine: Floats
    information: Floats
    support: Floats

    @staticmethod
    def none(number: int) -> Observations:
        """Of ``number`` points, by no photograph."""
        count, seen_past, support = np.zeros((3, number), np.float32)
        first, information = np.zeros((number, 3), np.float32), np.zeros((6, number), np.float32)
        return Observations(count, seen_past, first, np.ones_like(count), information, support)

    @property
    def parallax(self) -> Floats:
        """(N,) largest angle, in degrees, between the first photograph that sees the point and
        another one: at least half of the largest angle between any two."""
        return np.asarray(np.degrees(np.arccos(self.min_cosine)))

    def add(self, visibility: Visibility, points: QueryPoints) -> None:
        """Add a photograph."""
        visible, d = visibility.visible, visibility.to_camera
        self.seen_past += visibility.seen_past
        self.information[:, visible], self.support[visible] = self.updated(visibility, points)
        new = self.count[visible] == 0
        self.first_direction[visible[new]] = d[new]
        cosine = _cosine(d, self.first_direction[visible])
        self.min_cosine[visible] = np.minimum(self.min_cosine[visible], cosine)
        self.count[visible] += 1

    def updated(self, visibility: Visibility, points: QueryPoints) -> tuple[Floats, Floats]:
        """``information`` and ``support`` of the visible points as ``add`` would set them."""
        visible, d = visibility.visible, visibility.to_camera
        s = visibility.resolution / points.resolution[visible]
        x, y, z = d.T
        added = np.stack([1 - x * x, 1 - y * y, 1 - z * z, -x * y, -x * z, -y * z]) * (s * s)
        turn = (1 - _cosine(d, points.to_camera[visible])) / np.float32(HALF_SUPPORT_TURN)
        support = np.minimum(s, 1) / (1 + turn)
        return self.information[:, visible] + added, np.maximum(self.support[visible], support)


def collect_observations(photographs: Iterable[ProbeView], points: QueryPoints) -> Observations:
    """Observations of points by all given photographs."""
    observed = Observations.none(len(points))
    for photograph in photographs:
        observed.add(find_visible(photograph, points.xyz, points.empty), points)
    return observed


def trust(information: Floats, support: Floats, to_camera: Floats) -> Floats:
    """(N,) trust, in [0, 1], as defined above.

    Args:
        information: (6, N), see ``Observations``.
        support: (N,), see ``Observations``.
        to_camera: (N, 3) unit vectors from the points to the query cameras.
    """
    prior = np.float32(PRIOR_SIGMA_PX**-2)
    xx, yy, zz = information[:3] + prior
    xy, xz, yz = information[3:]
    # The adjugate: the inverse times the determinant.
    a, b, c = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    d, e, f = xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz
    determinant = xx * a + xy * d + xz * e
    x, y, z = to_camera.T
    along = a * x * x + b * y * y + c * z * z + 2 * (d * x * y + e * x * z + f * y * z)
    squared = np.maximum(a + b + c - along, 0) / np.maximum(determinant, np.float32(1e-30))
    return np.asarray(support / (1 + squared / np.float32(HALF_TRUST_ERROR_SQUARED)))


def trust_map(
    probe: ProbeView, photographs: Iterable[ProbeView], background_depth: float
) -> tuple[Floats, Observations]:
    """(H, W) trust of each pixel of a probe view, and the observations of its points, in row-major
    order.

    Args:
        background_depth: The depth of pixels whose ray meets no surface, world units.
    """
    points = backproject(probe, background_depth)
    observed = collect_observations(photographs, points)
    values = trust(observed.information, observed.support, points.to_camera)
    return values.reshape(probe.depth.shape), observed


def trust_maps(
    probes: Sequence[ProbeView],
    photographs: Sequence[ProbeView],
    background_depth: float,
    threads: int,
) -> Iterator[tuple[Floats, Observations]]:
    """``trust_map`` of each probe view, in order, ``threads`` views at a time."""
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        yield from pool.map(lambda probe: trust_map(probe, photographs, background_depth), probes)


def _cosine(a: Floats, b: Floats) -> Floats:
    """(N,) cosines of the angles between unit vectors."""
    product = a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]
    return np.asarray(product.clip(-1, 1))
