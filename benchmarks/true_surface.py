"""The true surfaces of the synthetic scenes, to compare meshes with."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.mesh_accuracy import MIN_VIEWS, Similarity, true_points
from benchmarks.town.layout import Town, build
from benchmarks.town.paths import cells_of
from benchmarks.town.solids import Ellipsoid, Prism
from benchmarks.town.write import TownSpec
from pipeline.demo.scene import distance
from pipeline.scene.views import View
from pipeline.surface.tsdf import camera_space

Array = NDArray[np.float64]

#: Solids at most this thick are thin parts, metres: fences, posts, rails.
THIN = 0.25
#: One point of the town's surface in each cube of this side, metres.
SPACING = 0.1


@dataclass(frozen=True)
class TrueSurface:
    """A surface that is known.

    Attributes:
        points: (P, 3) points of it that ``MIN_VIEWS`` training views see, evenly spread, metres.
        thin: (P,) which of them are on thin parts.
        distance: From (N, 3) points to the surface, (N,) metres.
    """

    points: Array
    thin: NDArray[np.bool_]
    distance: Callable[[Array], Array]


def demo_surface(views: list[View]) -> TrueSurface:
    """The surface of the demo scene, whose thin parts are not told apart."""
    points = true_points(views, Similarity(1.0, np.eye(3), np.zeros(3)))

    def to_surface(at: Array) -> Array:
        return np.asarray(np.abs(distance(at.T)))

    return TrueSurface(points, np.zeros(len(points), bool), to_surface)


def town_surface(folder: Path, views: Sequence[View]) -> TrueSurface:
    """The surface of the town in ``folder``, as its photographs with exact poses see it."""
    spec = TownSpec(**json.loads((folder / "town.json").read_text()))
    town = build(cells_of(spec.photographs), spec.seed)
    training = [view for view in views if not view.is_test]
    depths = [np.load(folder / "depth_gt" / f"{Path(view.name).stem}.npy") for view in training]
    points = _seen(training, depths)
    nearest = _nearest_solid(town, points)
    thickness = np.array([_thickness(solid) for solid in town.solids] + [np.inf])
    return TrueSurface(
        points, thickness[nearest] <= THIN, lambda at: np.abs(_signed_distance(town, at))
    )


def _seen(views: Sequence[View], depths: Sequence[NDArray[np.float32]]) -> Array:
    """Points of depth maps, one in each cube of ``SPACING``, that ``MIN_VIEWS`` views see."""
    found = []
    for view, depth in zip(views, depths, strict=True):
        row, column = np.nonzero(depth > 0)
        z = depth[row, column].astype(np.float64)
        local = np.column_stack(
            [(column + 0.5 - view.cx) / view.fx * z, (row + 0.5 - view.cy) / view.fy * z, z]
        )
        found.append(local @ view.world_to_camera[:3, :3] + view.centre)
    points = np.concatenate(found)
    _, first = np.unique(np.floor(points / SPACING).astype(int), axis=0, return_index=True)
    points = points[np.sort(first)]
    seen = np.zeros(len(points), int)
    for view, depth in zip(views, depths, strict=True):
        x, y, z = camera_space(view, points)
        front = np.maximum(z, 1e-9)
        u, v = view.fx * x / front + view.cx, view.fy * y / front + view.cy
        inside = (z > 0) & (u >= 0) & (v >= 0) & (u < view.width) & (v < view.height)
        column, row = (np.where(inside, at, 0).astype(int) for at in (u, v))
        seen += inside & (np.abs(depth[row, column] - z) < 0.02 * z)
    return points[seen >= MIN_VIEWS]


def _thickness(solid: Prism | Ellipsoid) -> float:
    """The least distance between two parallel planes around the solid, among those of its faces."""
    if isinstance(solid, Ellipsoid):
        return 2 * min(solid.radii)
    return min(
        float(np.ptp(solid.vertices @ (face.normal / np.linalg.norm(face.normal))))
        for face in solid.faces
    )


def _signed_distance(town: Town, points: Array) -> Array:
    """(N,) signed distances to the union of all solids and the ground."""
    best = points[:, 2].copy()
    for solid in town.solids:
        low, high = _bounds(solid)
        beside = np.maximum(np.maximum(low - points, points - high), 0)
        rows = np.flatnonzero(np.sqrt((beside * beside).sum(axis=1)) < best)
        best[rows] = np.minimum(best[rows], _to_solid(solid, points[rows]))
    return best


def _nearest_solid(town: Town, points: Array) -> NDArray[np.intp]:
    """(N,) the solid on whose surface each point is; their number for the ground."""
    best = np.asarray(np.abs(points[:, 2]))
    nearest = np.full(len(points), len(town.solids), np.intp)
    for number, solid in enumerate(town.solids):
        low, high = _bounds(solid)
        rows = np.flatnonzero((points > low - SPACING).all(1) & (points < high + SPACING).all(1))
        found = np.abs(_to_solid(solid, points[rows]))
        closer = found < best[rows]
        best[rows[closer]], nearest[rows[closer]] = found[closer], number
    return nearest


def _bounds(solid: Prism | Ellipsoid) -> tuple[Array, Array]:
    corners = solid.corners if isinstance(solid, Ellipsoid) else solid.vertices
    return corners.min(axis=0), corners.max(axis=0)


def _to_solid(solid: Prism | Ellipsoid, points: Array) -> Array:
    """(N,) signed distances to a solid: exact at the faces of a prism, too small beside its edges;
    to first order for an ellipsoid."""
    if isinstance(solid, Ellipsoid):
        radii = np.array(solid.radii)
        local = (points - np.array(solid.centre)) / radii
        length = np.linalg.norm(local, axis=1)
        slope = np.linalg.norm(local / radii, axis=1)
        return np.asarray(length * (length - 1) / np.maximum(slope, 1e-12))
    normals = np.array([face.normal for face in solid.faces])
    offsets = np.array([face.offset for face in solid.faces])
    return np.asarray((points @ normals.T - offsets).max(axis=1))
