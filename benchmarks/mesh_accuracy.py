"""Accuracy and completeness of a mesh against the true surface of the demo scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.demo.scene import OBJECTS, distance, trace
from pipeline.scene.views import View

Array = NDArray[np.float64]

#: Focus of the demo cameras and centre of the foreground, metres.
FOCUS = np.array([0.0, 0.0, 0.45])
#: Diameter of the foreground, a ball with all objects and the floor below them, metres.
FOREGROUND = 2.4
#: Least number of training views that see an evaluated point of the true surface.
MIN_VIEWS = 3
SAMPLES = 400_000
# Points of the true surface: one in each cube of this side, metres.
_SPACING = 0.02


@dataclass(frozen=True)
class Accuracy:
    """The accuracy of the mesh in a region of the scene.

    Attributes:
        size: The size of the region, metres.
        median, p90: Distances of the mesh's samples from the true surface, as shares of ``size``.
        completeness: The share of the true surface within 1 % of ``size`` of the mesh.
    """

    size: float
    median: float
    p90: float
    completeness: float


@dataclass(frozen=True)
class Similarity:
    """true = scale * rotation @ found + shift."""

    scale: float
    rotation: Array
    shift: Array

    def apply(self, points: Array) -> Array:
        """(N, 3) points of the reconstruction in the truth's frame."""
        return np.asarray(self.scale * points @ self.rotation.T + self.shift)

    def undo(self, points: Array) -> Array:
        return np.asarray((points - self.shift) @ self.rotation / self.scale)


def true_points(views: list[View], frame: Similarity) -> Array:
    """(P, 3) points of the true surface, evenly spread, that ``MIN_VIEWS`` training views see."""
    training = [view for view in views if not view.is_test]
    depths, found = [], []
    for view in training:
        column, row = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
        local = np.stack(
            [(column - view.cx) / view.fx, (row - view.cy) / view.fy, np.ones_like(row)], axis=-1
        ).reshape(-1, 3)
        rays = local @ view.world_to_camera[:3, :3] @ frame.rotation.T
        origin = frame.apply(view.centre[None])
        depth, _ = trace(origin.T, rays.T, OBJECTS)
        depths.append(depth.reshape(view.height, view.width))
        found.append((origin + depth[:, None] * rays)[::5])
    points = np.concatenate(found)
    _, first = np.unique(np.floor(points / _SPACING).astype(int), axis=0, return_index=True)
    points = points[first]
    seen = np.zeros(len(points), int)
    for view, depth in zip(training, depths, strict=True):
        world_to_camera = view.world_to_camera
        x, y, z = (frame.undo(points) @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]).T
        front = np.maximum(z, 1e-6)
        u, v = view.fx * x / front + view.cx, view.fy * y / front + view.cy
        inside = (z > 0) & (u >= 0) & (v >= 0) & (u < view.width) & (v < view.height)
        nearest = depth[np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int)]
        # Surfaces slope within a pixel.
        seen += inside & (np.abs(nearest - frame.scale * z) < 0.02 * frame.scale * z)
    return np.asarray(points[seen >= MIN_VIEWS])


def sample(vertices: NDArray[Any], faces: NDArray[Any], count: int) -> Array:
    """(count, 3) points spread over the triangles by area; always the same ones."""
    rng = np.random.default_rng(0)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return np.asarray(a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen])


def measure(
    vertices: NDArray[Any], faces: NDArray[Any], truth: Array, frame: Similarity
) -> dict[str, Accuracy]:
    """Accuracy in the ``foreground``, whose size is its diameter, and of the whole ``room``, whose
    size is the diagonal of what is seen of it.

    Args:
        vertices: (V, 3) in the reconstruction's frame. faces: (F, 3).
        truth: ``true_points``.
    """
    points = sample(frame.apply(np.asarray(vertices, np.float64)), faces, SAMPLES)
    off = np.abs(distance(points.T))
    missing, _ = cKDTree(points).query(truth)
    everywhere = float(np.linalg.norm(truth.max(axis=0) - truth.min(axis=0)))
    result = {}
    for name, size in (("foreground", FOREGROUND), ("room", everywhere)):
        near = [
            np.linalg.norm(p - FOCUS, axis=1) < (size / 2 if name == "foreground" else np.inf)
            for p in (points, truth)
        ]
        result[name] = Accuracy(
            size,
            float(np.median(off[near[0]])) / size,
            float(np.percentile(off[near[0]], 90)) / size,
            float((missing[near[1]] <= 0.01 * size).mean()),
        )
    return result
