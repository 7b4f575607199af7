"""How the formats of pose files write a pose, and other readings of one."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.io.poses.kinds import PoseKind

Array = NDArray[np.float64]

Direction = Literal["camera to world", "world to camera"]
Position = Literal["centre", "translation"]


@dataclass(frozen=True)
class PoseSet:
    """The poses of photographs in the order of their names, world to camera.

    Attributes:
        rotations: (N, 3, 3), COLMAP's axes; reflections if the world is mirrored.
        centres: (N, 3) positions in the given world.
        cameras: N cameras of the photographs' sizes.
    """

    rotations: Array
    centres: Array
    cameras: tuple[Camera, ...]

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def translations(self) -> Array:
        """(N, 3), world to camera."""
        return -np.einsum("nij,nj->ni", self.rotations, self.centres)

    def posed(self, rotations: Array, centres: Array) -> PoseSet:
        return replace(self, rotations=rotations, centres=centres)


@dataclass(frozen=True)
class Convention:
    """How a format writes a pose.

    Attributes:
        rotation: The direction of its rotation.
        position: Whether the file has the camera's centre, or the translation of world to camera.
        axes: (3, 3) from the axes of its cameras to COLMAP's.
    """

    rotation: Direction
    position: Position
    axes: Array

    def raw(self, poses: PoseSet) -> tuple[Array, Array]:
        """The rotations and positions that a file with ``poses`` has."""
        rotations = self.axes.T @ poses.rotations
        if self.position == "translation":
            positions = poses.translations @ self.axes
        else:
            positions = poses.centres
        if self.rotation == "camera to world":
            rotations = np.swapaxes(rotations, 1, 2)
        return rotations, positions

    def read(self, poses: PoseSet, rotations: Array, positions: Array) -> PoseSet:
        """``poses`` with those that a file with these rotations and positions has."""
        if self.rotation == "camera to world":
            rotations = np.swapaxes(rotations, 1, 2)
        if self.position == "translation":
            positions = -np.einsum("nji,nj->ni", rotations, positions)
        return poses.posed(self.axes @ rotations, positions)


COLMAP = np.eye(3)
OPENGL = np.diag([1.0, -1.0, -1.0])
PYTORCH3D = np.diag([-1.0, -1.0, 1.0])
# LLFF: down, right, backward.
LLFF = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
NAMED = ((COLMAP, "COLMAP's"), (OPENGL, "OpenGL's"), (PYTORCH3D, "PyTorch3D's"), (LLFF, "LLFF's"))

CONVENTIONS: dict[PoseKind, Convention] = {
    "colmap": Convention("world to camera", "translation", COLMAP),
    "transforms": Convention("camera to world", "centre", OPENGL),
    "llff": Convention("camera to world", "centre", LLFF),
    "metashape": Convention("camera to world", "centre", COLMAP),
    "realitycapture_csv": Convention("camera to world", "centre", OPENGL),
    "realitycapture_xmp": Convention("world to camera", "centre", COLMAP),
    "polycam": Convention("camera to world", "centre", OPENGL),
    "record3d": Convention("camera to world", "centre", OPENGL),
    "scannet": Convention("camera to world", "centre", COLMAP),
    "bundler": Convention("world to camera", "translation", OPENGL),
    "opensfm": Convention("world to camera", "translation", COLMAP),
    "openmvg": Convention("world to camera", "centre", COLMAP),
    "pix4d": Convention("world to camera", "centre", COLMAP),
    "pix4d_angles": Convention("camera to world", "centre", OPENGL),
}
# The cause and the fix of translations where centres are expected.
TRANSLATIONS = (
    "the positions look like the translations t of world to camera, expected the cameras' centres",
    "write the centres, -R^T t",
)
ANGLES: tuple[PoseKind, ...] = ("realitycapture_csv", "pix4d_angles")


@dataclass(frozen=True)
class Reading:
    """Another reading of the given poses.

    Attributes:
        cause: The likely mistake in the file, as the end of "the poses look as if ...".
        fix: The way to correct the file.
        poses: The poses and cameras of this reading.
        rank: The order of preference among equally good readings, lowest first.
    """

    cause: str
    fix: str
    poses: PoseSet
    rank: int


def describe_axes(axes: Array) -> str:
    """The name of camera axes, and the directions of x, y and z, such as "COLMAP's (x right, y
    down, z forward)"."""
    words = (("right", "left"), ("down", "up"), ("forward", "backward"))
    parts = []
    for name, column in zip("xyz", axes.T, strict=True):
        at = int(np.abs(column).argmax())
        parts.append(f"{name} {words[at][0 if column[at] > 0 else 1]}")
    described = ", ".join(parts)
    known = next((name for matrix, name in NAMED if np.array_equal(matrix, axes)), None)
    if known is not None:
        return f"{known} ({described})"
    mirrored = np.linalg.det(axes) < 0
    return f"{described}" + (" (mirrored, left-handed)" if mirrored else "")


def signed_permutations() -> list[Array]:
    return [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]


def explained(expected: Convention, found: Convention) -> tuple[str, str]:
    causes, fixes = [], []
    turned = found.rotation != expected.rotation
    moved = found.position != expected.position
    if turned and moved:
        causes.append(f"the poses look like {found.rotation}, expected {expected.rotation}")
        fixes.append("invert the matrices")
    elif turned:
        causes.append(
            f"the rotations look transposed ({found.rotation}, expected {expected.rotation})"
        )
        fixes.append("transpose the rotations")
    elif moved and found.position == "translation":
        causes.append(TRANSLATIONS[0])
        fixes.append(TRANSLATIONS[1])
    elif moved:
        causes.append(
            "the translations look like the cameras' centres C, expected those of world to camera"
        )
        fixes.append("write the translations, -R C")
    if not np.array_equal(found.axes, expected.axes):
        causes.append(
            f"the camera axes look like {describe_axes(found.axes)}, expected "
            f"{describe_axes(expected.axes)}"
        )
        fixes.append(_axes_fix(expected, found))
    return " and ".join(causes), " and ".join(fixes)


def _axes_fix(expected: Convention, found: Convention) -> str:
    # Column k: the found axis that the expected axis k is.
    change = found.axes.T @ expected.axes
    lines = "columns" if expected.rotation == "camera to world" else "rows"
    if np.count_nonzero(np.diag(change)) == 3:
        negative = [i + 1 for i in range(3) if change[i, i] < 0]
        which = " and ".join(str(i) for i in negative)
        one = len(negative) == 1
        return f"negate {lines[:-1] if one else lines} {which} of the rotations" + (
            " and of the positions' world" if np.linalg.det(change) < 0 else ""
        )
    return f"reorder the {lines} of the rotations to {', '.join(signed_axes(change.T, '123'))}"


def signed_axes(axes: Array, names: str) -> list[str]:
    """The name of the axis that each row of a signed permutation has, with its sign."""
    columns = np.abs(axes).argmax(axis=1)
    rows = zip(axes, columns, strict=True)
    return [f"{'-' if row[at] < 0 else ''}{names[at]}" for row, at in rows]
