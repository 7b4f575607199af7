"""Other readings of given poses: the mistakes that people make when they write pose files.

Each reading changes the given poses or cameras as if the file followed another convention than its
format's. Which one is right is decided by the photographs' own matches (``pose_check``).
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import quat_to_rotation, rotation_from_vector, rotation_to_quat
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
        rotation: the direction of its rotation.
        position: whether it has the camera's centre, or the translation of world to camera.
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
_NAMED = ((COLMAP, "COLMAP's"), (OPENGL, "OpenGL's"), (PYTORCH3D, "PyTorch3D's"), (LLFF, "LLFF's"))

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
_ANGLES: tuple[PoseKind, ...] = ("realitycapture_csv", "pix4d_angles")


@dataclass(frozen=True)
class Reading:
    """Another reading of the given poses.

    Attributes:
        cause: what the file looks like, as the end of "the poses look as if ...".
        fix: how to correct the file.
        poses: the poses and cameras of this reading.
        rank: readings that are as good are preferred by the lowest rank.
    """

    cause: str
    fix: str
    poses: PoseSet
    rank: int


def turned_readings(given: PoseSet, kind: PoseKind) -> list[Reading]:
    """The readings of other axes and directions that are common: those that fit as well as the
    right one if the cameras move in a line without turning."""
    return [r for r in _interpretations(given, CONVENTIONS[kind]) if r.rank <= 2]


def readings(given: PoseSet, kind: PoseKind, names: Sequence[str]) -> Iterator[Reading]:
    """All other readings of poses that were read as of ``kind``.

    Args:
        names: the photographs in the order of ``given``.
    """
    convention = CONVENTIONS[kind]
    simple = [
        *_interpretations(given, convention),
        *_quaternions(given, convention),
        *_orders(given, names),
        *_intrinsics(given),
    ]
    if kind in _ANGLES:
        simple += _angles(given, convention)
    yield from simple
    yield from _positions(given)
    for axes in _two_mistakes(given, convention):
        yield from (
            replace(second, cause=f"{axes.cause}; {second.cause}", fix=f"{axes.fix}; {second.fix}")
            for second in (
                *_orders(axes.poses, names, 4),
                *_intrinsics(axes.poses, 4, _FACTORS[1::2]),
            )
        )


def translation_centres(given: PoseSet, kind: PoseKind) -> Array:
    """(N, 3) the numbers that a file of ``kind`` would have if it had the other kind of position:
    the cameras' centres if what is there are translations, or the opposite."""
    return (
        CONVENTIONS[kind].raw(given)[1]
        if CONVENTIONS[kind].position == "translation"
        else (given.translations)
    )


def describe_axes(axes: Array) -> str:
    """The name of camera axes, and the directions of x, y and z, such as "COLMAP's (x right, y
    down, z forward)"."""
    words = (("right", "left"), ("down", "up"), ("forward", "backward"))
    parts = []
    for name, column in zip("xyz", axes.T, strict=True):
        at = int(np.abs(column).argmax())
        parts.append(f"{name} {words[at][0 if column[at] > 0 else 1]}")
    described = ", ".join(parts)
    known = next((name for matrix, name in _NAMED if np.array_equal(matrix, axes)), None)
    if known is not None:
        return f"{known} ({described})"
    mirrored = np.linalg.det(axes) < 0
    return f"{described}" + (" (mirrored, left-handed)" if mirrored else "")


def _signed_permutations() -> list[Array]:
    return [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]


def _interpretations(given: PoseSet, convention: Convention) -> list[Reading]:
    """Other axes, directions of the rotation and meanings of the position."""
    rotations, positions = convention.raw(given)
    found = []
    directions: tuple[Direction, ...] = ("camera to world", "world to camera")
    meanings: tuple[Position, ...] = ("centre", "translation")
    for direction, meaning in itertools.product(directions, meanings):
        for axes in _signed_permutations():
            other = Convention(direction, meaning, axes)
            same = np.array_equal(axes, convention.axes)
            changes = (direction != convention.rotation, meaning != convention.position, not same)
            if not any(changes):
                continue
            cause, fix = _explained(convention, other)
            named = any(np.array_equal(axes, matrix) for matrix, _ in _NAMED)
            rank = (0 if changes[0] == changes[1] else 1) + (0 if same else 1 if named else 3)
            poses = other.read(given, rotations, positions)
            found.append(Reading(cause, fix, poses, rank))
    return found


def _explained(expected: Convention, found: Convention) -> tuple[str, str]:
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
        causes.append(
            "the positions look like the translations t of world to camera, expected the cameras' "
            "centres"
        )
        fixes.append("write the centres, -R^T t")
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
    parts = []
    for k in range(3):
        at = int(np.abs(change[:, k]).argmax())
        parts.append(f"{'-' if change[at, k] < 0 else ''}{at + 1}")
    return f"reorder the {lines} of the rotations to {', '.join(parts)}"


def _quaternions(given: PoseSet, convention: Convention) -> list[Reading]:
    """Quaternions with the real part at the other end, before or after an inversion."""
    found = []
    for axes in (convention.axes, COLMAP):
        form = replace(convention, axes=axes)
        rotations, positions = convention.raw(given)
        for transposed, shift in itertools.product((False, True), (-1, 1)):
            wrong = np.swapaxes(rotations, 1, 2) if transposed else rotations
            right = quat_to_rotation(np.roll(rotation_to_quat(wrong), shift, axis=-1))
            right = np.swapaxes(right, 1, 2) if transposed else right
            order = "x, y, z, w for w, x, y, z" if shift == 1 else "w, x, y, z for x, y, z, w"
            other = None if np.array_equal(axes, convention.axes) else _explained(convention, form)
            cause = f"the order of the quaternions looks like {order}"
            fix = "reorder the quaternions' numbers"
            if other is not None:
                cause, fix = f"{cause} and {other[0]}", f"{fix} and {other[1]}"
            rank = 2 if other is None else 4
            found.append(Reading(cause, fix, form.read(given, right, positions), rank))
            # Translations may have been computed with the wrong rotations.
            flipped: Position = "translation" if form.position == "centre" else "centre"
            kept = replace(convention, position=flipped).raw(given)[1]
            found.append(
                Reading(
                    cause, fix, replace(form, position=flipped).read(given, right, kept), rank + 1
                )
            )
    return found


def _orders(given: PoseSet, names: Sequence[str], rank: int = 1) -> list[Reading]:
    """Poses of the neighbouring photograph, in reverse, or in the other order of numbers."""
    count = len(given)
    orders: list[tuple[str, NDArray[np.int64]]] = []
    for step in (1, -1, 2, -2, 3, -3):
        if abs(step) < count:
            where = "after" if step > 0 else "before"
            text = f"{'the' if abs(step) == 1 else f'{abs(step)}'} {where} it"
            orders.append(
                (
                    "each photograph has the pose of the one "
                    + (text.replace("the ", "") if abs(step) == 1 else text),
                    np.roll(np.arange(count), step),
                )
            )
    orders.append(("the photographs are in reverse order", np.arange(count)[::-1]))
    natural = np.array(sorted(range(count), key=lambda i: _natural_key(names[i])))
    if not np.array_equal(natural, np.arange(count)):
        text = "the poses are in the order of numbers (2 before 10), the names in that of letters"
        orders += [(text, np.argsort(natural)), (text, natural)]
    found = []
    for cause, order in orders:
        cameras = tuple(_as_size(given.cameras[i], given.cameras[k]) for k, i in enumerate(order))
        if all(a is b for a, b in zip(cameras, given.cameras, strict=True)):
            cameras = given.cameras  # Their rays are known.
        poses = PoseSet(given.rotations[order], given.centres[order], cameras)
        fix = "correct which photograph each pose belongs to"
        found.append(Reading(cause, fix, poses, rank))
    return found


def _natural_key(name: str) -> list[tuple[int, str]]:
    return [
        (int(part[:18]), "") if part.isdigit() else (-1, part)
        for part in re.split(r"([0-9]+)", name)
    ]


def _as_size(camera: Camera, other: Camera) -> Camera:
    if (camera.width, camera.height) == (other.width, other.height):
        return camera
    return camera.resized(other.width, other.height)


_FACTORS = tuple(2.0 ** (k / 4) for k in range(-24, 25) if abs(k) > 1)


# Focal lengths of ordinary cameras, divided by the longer side: others are not proposed.
_ORDINARY = (0.25, 8.0)


def _intrinsics(given: PoseSet, rank: int = 1, factors: Sequence[float] = ()) -> list[Reading]:
    """Focal lengths and principal points of another image size, in another unit or exchanged."""
    if any(camera.is_spherical for camera in given.cameras):
        return []
    factors = factors or _FACTORS
    found = []

    def add(cause: str, fix: str, change: Callable[[Camera], Camera], extra: int = 0) -> None:
        changed = {id(camera): change(camera) for camera in given.cameras}
        cameras = tuple(changed[id(camera)] for camera in given.cameras)
        found.append(Reading(cause, fix, replace(given, cameras=cameras), rank + extra))

    first = given.cameras[0].pinhole[0]
    unit = "write the intrinsics of images of the photographs' size, in pixels"
    side = max(given.cameras[0].width, given.cameras[0].height)
    for factor in factors:
        if not _ORDINARY[0] < first * factor / side < _ORDINARY[1]:
            continue
        text = (
            f"the focal length looks like {_rounded(first * factor)} pixels, not {first:.4g}: that "
            "of another image size, in another unit or from another angle"
        )
        add(text, unit, partial(_scaled, factor=factor))
        add(
            f"{text}; the principal point looks like the image's centre",
            unit,
            partial(_scaled, factor=factor, centred=True),
            1,
        )
        text = f"the intrinsics look like those of images {_rounded(1 / factor)} times as large"
        add(text, unit, partial(_scaled, factor=factor, with_point=True))
    add(
        "the principal point looks like the image's centre, not "
        + ", ".join(f"{value:.4g}" for value in given.cameras[0].pinhole[2:]),
        "write the principal point in pixels from the upper left corner",
        _centred,
    )
    add(
        "cx and cy look exchanged",
        "exchange cx and cy",
        lambda c: _with_pinhole(c, c.pinhole[0], c.pinhole[1], c.pinhole[3], c.pinhole[2]),
    )
    return found


def _rounded(value: float) -> str:
    return f"{value:.2g}" if value < 100 else f"{round(value, -1):.0f}"


def _scaled(
    camera: Camera, factor: float, *, centred: bool = False, with_point: bool = False
) -> Camera:
    """The camera with another focal length, and with another principal point on request."""
    fx, fy, cx, cy = (_centred(camera) if centred else camera).pinhole
    point = (cx * factor, cy * factor) if with_point else (cx, cy)
    return _with_pinhole(camera, fx * factor, fy * factor, *point)


def _centred(camera: Camera) -> Camera:
    fx, fy = camera.pinhole[:2]
    return _with_pinhole(camera, fx, fy, camera.width / 2, camera.height / 2)


def _with_pinhole(camera: Camera, fx: float, fy: float, cx: float, cy: float) -> Camera:
    params = camera.params.copy()
    one = camera.intrinsics_names[0] == "f"
    params[: 3 if one else 4] = (fx, cx, cy) if one else (fx, fy, cx, cy)
    return replace(camera, params=params)


def _angles(given: PoseSet, convention: Convention) -> list[Reading]:
    """Angles in radians, of other signs, from another zero, or in another order."""
    rotations, positions = convention.raw(given)
    found = []
    for name, (split, join) in _EULER.items():
        degrees = np.degrees(split(rotations))
        if np.abs(degrees).max() < 7:
            right = convention.read(given, join(degrees), positions)
            cause = "the angles look like radians, expected degrees"
            found.append(Reading(cause, "multiply the angles by 180 / pi", right, 0))
        for order in itertools.permutations(range(3)):
            for signs in itertools.product((1.0, -1.0), repeat=3):
                for zero in (0.0, 90.0, -90.0):
                    angles = degrees[:, list(order)] * signs + (0.0, zero, 0.0)
                    changes = [order != (0, 1, 2), -1 in signs, zero != 0]
                    what = [
                        text
                        for text, changed in zip(
                            ("in another order", "of another sign", "counted from another zero"),
                            changes,
                            strict=True,
                        )
                        if changed
                    ]
                    for target, (_, other) in _EULER.items():
                        words = [*what, *(["of rotations in another order"] * (target != name))]
                        if not words:
                            continue
                        right = convention.read(given, other(np.radians(angles)), positions)
                        cause = f"the angles look {' and '.join(words)}"
                        fix = "write the angles as the program does that the format belongs to"
                        found.append(Reading(cause, fix, right, 2 + len(words)))
    return found


def _split_zxy(matrix: Array) -> Array:
    """(N, 3) heading, pitch and roll of Rz(-heading) Rx(pitch) Ry(roll)."""
    heading = np.arctan2(matrix[:, 0, 1], matrix[:, 1, 1])
    pitch = np.arcsin(np.clip(matrix[:, 2, 1], -1, 1))
    roll = np.arctan2(-matrix[:, 2, 0], matrix[:, 2, 2])
    return np.column_stack([heading, pitch, roll])


def _join_zxy(angles: Array) -> Array:
    return _turns(angles * (-1, 1, 1), (2, 0, 1))


def _split_xyz(matrix: Array) -> Array:
    """(N, 3) omega, phi and kappa of Rx(omega) Ry(phi) Rz(kappa)."""
    omega = np.arctan2(-matrix[:, 1, 2], matrix[:, 2, 2])
    phi = np.arcsin(np.clip(matrix[:, 0, 2], -1, 1))
    kappa = np.arctan2(-matrix[:, 0, 1], matrix[:, 0, 0])
    return np.column_stack([omega, phi, kappa])


def _join_xyz(angles: Array) -> Array:
    return _turns(angles, (0, 1, 2))


def _turns(angles: Array, axes: Sequence[int]) -> Array:
    parts = [
        np.stack([rotation_from_vector(np.eye(3)[axis] * angle) for angle in angles[:, k]])
        for k, axis in enumerate(axes)
    ]
    return np.asarray(parts[0] @ parts[1] @ parts[2])


_EULER: dict[str, tuple[Callable[[Array], Array], Callable[[Array], Array]]] = {
    "heading, pitch, roll": (_split_zxy, _join_zxy),
    "omega, phi, kappa": (_split_xyz, _join_xyz),
}


def _positions(given: PoseSet) -> list[Reading]:
    """Positions whose world has other axes than that of the rotations."""
    found = []
    for axes in _signed_permutations():
        if np.array_equal(axes, np.eye(3)):
            continue
        words = []
        for row in axes:
            at = int(np.abs(row).argmax())
            words.append(f"{'-' if row[at] < 0 else ''}{'xyz'[at]}")
        mirrored = ", mirrored" if np.linalg.det(axes) < 0 else ""
        cause = (
            "the positions and the rotations look like those of worlds with different axes "
            f"({', '.join(words)} for x, y, z{mirrored})"
        )
        fix = "convert positions and rotations in the same way"
        found.append(Reading(cause, fix, given.posed(given.rotations, given.centres @ axes.T), 4))
    return found


def _two_mistakes(given: PoseSet, convention: Convention) -> Iterator[Reading]:
    """The common mistakes of axes and directions that occur together with others."""
    rotations, positions = convention.raw(given)
    for direction, meaning in (
        ("camera to world", "centre"),
        ("world to camera", "translation"),
    ):
        for axes in (COLMAP, OPENGL):
            other = Convention(direction, meaning, axes)  # type: ignore[arg-type]
            cause, fix = _explained(convention, other)
            if cause:
                yield Reading(cause, fix, other.read(given, rotations, positions), 4)
