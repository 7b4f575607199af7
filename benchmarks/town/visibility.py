"""First hits of a view's rays with the town's solids.

Along a ray C + t d of unit depth, the plane n . x = o is met at 1/t = n . d / (o - n . C), which is
linear in d. So the inverse depths of a convex solid's faces are linear functions on the image
plane: a ray enters the solid at the smallest of those of the faces that the camera is outside of,
and misses it where one of those that the camera is inside of is larger. Each solid is compared only
with the rays in the rectangle around its projection, nearest solids first; a solid whose nearest
point is farther than everything found in its rectangle is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from benchmarks.town.solids import Ellipsoid, Prism, Solid
from pipeline.scene.reconstruction import PosedImage

Array = NDArray[np.float64]

# The depth at which solids around the camera are cut, metres.
NEAR = 0.05
# The depth at which the ground ends, metres.
FAR = 700.0
SKY, GROUND = 0, 1
# The number of rays compared at once, whose arrays stay in the cache.
BATCH = 65_536


@dataclass(frozen=True)
class Grid:
    """Rays of unit depth through a raster of points on the image.

    Attributes:
        x, y: The first two components in the camera's frame, (R, C); the third is 1. They increase
            along the rows and columns, as those of any lens without folds.
    """

    x: NDArray
    y: NDArray

    @cached_property
    def _columns(self) -> tuple[NDArray, NDArray]:
        return self.x.min(0), self.x.max(0)

    @cached_property
    def _rows(self) -> tuple[NDArray, NDArray]:
        return self.y.min(1), self.y.max(1)

    def window(self, low: Array, high: Array) -> tuple[int, int, int, int]:
        """The rows [r0, r1) and columns [c0, c1) that hold all rays with ``low`` <= (x, y) <=
        ``high``; empty if there are none."""
        left, right = self._columns
        top, bottom = self._rows
        c0, c1 = np.searchsorted(right, low[0]), np.searchsorted(left, high[0], "right")
        r0, r1 = np.searchsorted(bottom, low[1]), np.searchsorted(top, high[1], "right")
        return int(r0), int(r1), int(c0), int(c1)


@dataclass(frozen=True)
class Hits:
    """The first hits of the rays of a grid.

    Attributes:
        inverse: The inverse depths, (R, C); 0 where there is nothing but sky.
        label: The labels, (R, C): SKY, GROUND, or the index into ``seen`` plus 2.
        seen: The solids, and the face of each (0 of ellipsoids).
        tests: The number of pairs of a ray and a solid that were compared.
    """

    inverse: NDArray
    label: NDArray
    seen: list[tuple[Solid, int]]
    tests: int


@dataclass(frozen=True)
class Shapes:
    """The solids of a town, with the corners of all of them in one array.

    Attributes:
        solids: The solids, in any order.
        corners: The corners, (S, V, 3); short lists are filled with their last corner.
    """

    solids: tuple[Solid, ...]
    corners: Array

    @classmethod
    def of(cls, solids: list[Solid]) -> Shapes:
        lists = [s.vertices if isinstance(s, Prism) else s.corners for s in solids]
        most = max(len(corners) for corners in lists)
        rows = [np.pad(corners, ((0, most - len(corners)), (0, 0)), "edge") for corners in lists]
        return cls(tuple(solids), np.stack(rows))


def visible(shapes: Shapes, posed: PosedImage, grid: Grid) -> Hits:
    """The first hits of the grid's rays from a camera with solids and ground; in the precision of
    the grid."""
    inverse = np.zeros_like(grid.x)
    order, low, high, nearest = _candidates(shapes, posed, grid)
    # 16 bits are sorted faster. The solids here have at most as many faces as corners.
    most = len(order) * shapes.corners.shape[1]
    label = np.zeros(grid.x.shape, np.uint16 if most < 65_000 else np.uint32)
    _ground(posed, grid, inverse, label)
    seen: list[tuple[Solid, int]] = []
    tests = 0
    for index in order:
        r0, r1, c0, c1 = grid.window(low[index], high[index])
        if r0 >= r1 or c0 >= c1 or inverse[r0:r1, c0:c1].min() >= nearest[index]:
            continue
        solid = shapes.solids[index]
        rows = max(1, BATCH // (c1 - c0))
        compare = _prism if isinstance(solid, Prism) else _ellipsoid
        planes = compare(solid, posed)  # type: ignore[arg-type]
        if planes is None:
            continue
        for start in range(r0, r1, rows):
            part = slice(start, min(start + rows, r1)), slice(c0, c1)
            planes.compare(grid.x[part], grid.y[part], inverse[part], label[part], len(seen) + 2)
        seen += [(solid, face) for face in planes.faces]
        tests += (r1 - r0) * (c1 - c0)
    return Hits(inverse, label, seen, tests)


def _candidates(
    shapes: Shapes, posed: PosedImage, grid: Grid
) -> tuple[NDArray[np.intp], Array, Array, Array]:
    """The solids in front of the camera whose projections meet the image, nearest first; and of all
    solids the bounds of the projection, (S, 2), and the largest inverse depth, (S,)."""
    offset = shapes.corners - posed.centre
    # Avoid a matrix product: BLAS may round differently with the number of threads.
    local = [(offset * row).sum(-1) for row in posed.rotation]
    x, y, z = local
    front = np.maximum(z, NEAR)
    low = np.stack([(x / front).min(1), (y / front).min(1)], axis=1)
    high = np.stack([(x / front).max(1), (y / front).max(1)], axis=1)
    nearest = 1.0 / front.min(1)
    for index in np.flatnonzero((z.min(1) < NEAR) & (z.max(1) > NEAR)):
        low[index], high[index] = _cut(np.stack([x[index], y[index], z[index]], axis=1))
        nearest[index] = np.inf
    inside = (z.max(1) > NEAR) & (high[:, 0] >= grid.x.min()) & (low[:, 0] <= grid.x.max())
    inside &= (high[:, 1] >= grid.y.min()) & (low[:, 1] <= grid.y.max())
    found = np.flatnonzero(inside)
    distance = (offset[found] ** 2).sum(-1).min(1)
    return found[np.argsort(distance, kind="stable")], low, high, nearest


def _cut(corners: Array) -> tuple[Array, Array]:
    """The bounds of the projection of the part of a convex solid beyond NEAR, from its corners in
    the camera's frame: those beyond, and where the lines between corners cross NEAR."""
    beyond = corners[corners[:, 2] > NEAR]
    before = corners[corners[:, 2] <= NEAR]
    share = (NEAR - before[:, None, 2]) / (beyond[None, :, 2] - before[:, None, 2])
    crossing = before[:, None] + share[..., None] * (beyond[None] - before[:, None])
    points = np.concatenate([beyond, crossing.reshape(-1, 3)])
    flat = points[:, :2] / np.maximum(points[:, 2:], NEAR)
    return flat.min(0), flat.max(0)


def _ground(posed: PosedImage, grid: Grid, inverse: NDArray, label: NDArray) -> None:
    a, b, c = posed.rotation[:, 2] / -posed.centre[2]
    for start in range(0, len(inverse), 64):
        part = slice(start, start + 64)
        found = _linear((a, b, c), grid.x[part], grid.y[part])
        hit = found > 1 / FAR
        inverse[part] = np.where(hit, found, 0)
        label[part][hit] = GROUND


def _linear(weights: tuple[float, float, float] | Array, x: NDArray, y: NDArray) -> NDArray:
    a, b, c = (x.dtype.type(w) for w in weights)
    total = x * a
    total += y * b
    total += c
    return total


@dataclass(frozen=True)
class _Planes:
    """A prism seen from a camera: inverse depths of its faces as weights of (x, y, 1).

    Attributes:
        outside: The weights of the faces that the camera is outside of, (F, 3).
        inside: The weights of the other faces, (G, 3).
        faces: The indices of the faces of ``outside``.
    """

    outside: Array
    inside: Array
    faces: list[int]

    def compare(self, x: NDArray, y: NDArray, inverse: NDArray, label: NDArray, first: int) -> None:
        enter = _linear(self.outside[0], x, y)
        which = np.zeros(x.shape, np.uint8)
        for i, weights in enumerate(self.outside[1:], 1):
            other = _linear(weights, x, y)
            which[other < enter] = i
            np.minimum(enter, other, out=enter)
        leave = inverse.copy()  # It is not less than 0, so solids behind the camera are not seen.
        for weights in self.inside:
            np.maximum(leave, _linear(weights, x, y), out=leave)
        hit = enter > leave
        inverse[hit] = enter[hit]
        label[hit] = which[hit].astype(label.dtype) + label.dtype.type(first)


def _prism(solid: Prism, posed: PosedImage) -> _Planes | None:
    gaps = np.array([face.offset - (face.normal * posed.centre).sum() for face in solid.faces])
    normals = np.stack([face.normal for face in solid.faces])
    turned = np.stack([(normals * row).sum(1) for row in posed.rotation], axis=1)
    outside = np.flatnonzero(gaps < 0)
    if len(outside) == 0:
        return None
    weights = turned / np.where(gaps == 0, 1e-12, gaps)[:, None]
    return _Planes(weights[outside], weights[gaps >= 0], [int(i) for i in outside])


@dataclass(frozen=True)
class _Quadric:
    """An ellipsoid seen from a camera, in a frame where it is the unit sphere.

    Attributes:
        axes: The components of a ray in that frame as weights of (x, y, 1), (3, 3).
        towards: The negative product of the camera's position with a ray, as weights, (3,).
        gap: The squared distance of the camera from the centre, minus 1.
    """

    axes: Array
    towards: Array
    gap: float
    faces: list[int]

    def compare(self, x: NDArray, y: NDArray, inverse: NDArray, label: NDArray, first: int) -> None:
        square = sum(_linear(weights, x, y) ** 2 for weights in self.axes)
        toward = _linear(self.towards, x, y)
        inner = toward * toward - square * x.dtype.type(self.gap)
        enter = (toward + np.sqrt(np.maximum(inner, 0))) / x.dtype.type(self.gap)
        hit = (inner > 0) & (enter > inverse)
        inverse[hit] = enter[hit]
        label[hit] = first


def _ellipsoid(solid: Ellipsoid, posed: PosedImage) -> _Quadric | None:
    radii = np.array(solid.radii)
    offset = (posed.centre - np.array(solid.centre)) / radii
    gap = float((offset**2).sum() - 1)
    if gap <= 0:
        return None
    axes = posed.rotation.T / radii[:, None]
    return _Quadric(axes, -(axes * offset[:, None]).sum(0), gap, [0])
