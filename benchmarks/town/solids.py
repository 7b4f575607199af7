"""Solids of the town: convex prisms with a texture on each face, and ellipsoids.

World frame as in the demo scene: z up, the ground at 0, metres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.town.finishes import Finish

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Face:
    """A face of a prism.

    Attributes:
        normal: The outward unit normal, (3,).
        offset: The number for which points of the plane satisfy normal . x = offset.
        origin: The top left corner of the texture, seen from outside, (3,).
        right, down: The unit vectors of the texture's axes, (3,).
        width, height: The metres covered by the texture.
        finish: What is painted on it.
    """

    normal: Array
    offset: float
    origin: Array
    right: Array
    down: Array
    width: float
    height: float
    finish: Finish


@dataclass(frozen=True)
class Prism:
    """A convex solid: the intersection of the half-spaces of its faces.

    Attributes:
        faces: The faces that bound it.
        vertices: The corners, (V, 3).
    """

    faces: tuple[Face, ...]
    vertices: Array


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid with axes along the world's, for crowns of trees and shrubs.

    Attributes:
        centre, radii: The centre and the radii, metres.
        colour: The linear RGB albedo.
        seed: The offset of its texture.
    """

    centre: Triple
    radii: Triple
    colour: Triple
    seed: int

    @property
    def corners(self) -> Array:
        """The corners of the bounding box, (8, 3)."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
        return np.asarray(np.array(self.centre) + signs * np.array(self.radii))


Solid = Prism | Ellipsoid


@dataclass(frozen=True)
class Frame:
    """An orthonormal, right-handed frame: the profile of a prism lies in the plane of ``first`` and
    ``second`` and is extruded along ``third``."""

    origin: Array
    first: Array
    second: Array
    third: Array


def prism(
    profile: list[tuple[float, float]],
    length: float,
    frame: Frame,
    finish: Callable[[Array], Finish],
) -> Prism:
    """A convex polygon, extruded.

    Args:
        profile: The corners in the plane of the frame's first two axes, in either order.
        length: The extent along the third axis, from the frame's origin.
        finish: The finish of a face by its outward normal.
    """
    corners = np.array(profile, np.float64)
    following = np.roll(corners, -1, axis=0)
    area = (corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]).sum()
    if area < 0:
        corners = corners[::-1]
        following = np.roll(corners, -1, axis=0)
    near = frame.origin + corners[:, :1] * frame.first + corners[:, 1:] * frame.second
    far = near + length * frame.third
    ends = np.roll(np.arange(len(corners)), -1)
    faces = [
        _face(-frame.third, near, finish),
        _face(frame.third, far, finish),
    ]
    for i, j in enumerate(ends):
        edge = corners[j] - corners[i]
        normal = edge[1] * frame.first - edge[0] * frame.second
        normal = normal / np.linalg.norm(normal)
        faces.append(_face(normal, np.stack([near[i], near[j], far[i], far[j]]), finish))
    return Prism(tuple(faces), np.concatenate([near, far]))


def box(
    centre: tuple[float, float],
    size: Triple,
    bottom: float,
    yaw: float,
    finish: Callable[[Array], Finish],
) -> Prism:
    """An upright box: ``size`` along its own axes, which are turned by ``yaw`` radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    frame = Frame(
        np.array([*centre, bottom]), np.array([c, s, 0.0]), np.array([-s, c, 0.0]), UP.copy()
    )
    a, b = size[0] / 2, size[1] / 2
    return prism([(-a, -b), (a, -b), (a, b), (-a, b)], size[2], frame, finish)


def _face(normal: Array, corners: Array, finish: Callable[[Array], Finish]) -> Face:
    """A face with its texture's frame: upright on walls, up the slope on roofs, along y on level
    faces."""
    up = UP - normal[2] * normal
    steep = float(np.linalg.norm(up))
    up = up / steep if steep > 1e-6 else np.array([0.0, 1.0, 0.0])
    right = np.cross(up, normal)
    across, along = (corners * right).sum(1), (corners * up).sum(1)
    offset = float((corners[0] * normal).sum())
    origin = across.min() * right + along.max() * up + offset * normal
    return Face(
        normal=normal,
        offset=offset,
        origin=origin,
        right=right,
        down=-up,
        width=float(np.ptp(across)),
        height=float(np.ptp(along)),
        finish=finish(normal),
    )
