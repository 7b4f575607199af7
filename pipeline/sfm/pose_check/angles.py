"""Other readings of given rotations: quaternions and angles."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.rotations import quat_to_rotation, rotation_to_quat
from pipeline.sfm.pose_check.conventions import (
    COLMAP,
    Convention,
    PoseSet,
    Position,
    Reading,
    explained,
)

Array = NDArray[np.float64]


def quaternions(given: PoseSet, convention: Convention) -> list[Reading]:
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
            other = None if np.array_equal(axes, convention.axes) else explained(convention, form)
            cause = f"the order of the quaternions looks like {order}"
            fix = "reorder the quaternions' numbers"
            if other is not None:
                cause, fix = f"{cause} and {other[0]}", f"{fix} and {other[1]}"
            rank = 2 if other is None else 4
            found.append(Reading(cause, fix, form.read(given, right, positions), rank))
            # Translations may have been computed with the wrong rotations.
            flipped: Position = "translation" if form.position == "centre" else "centre"
            kept = replace(convention, position=flipped).raw(given)[1]
            poses = replace(form, position=flipped).read(given, right, kept)
            found.append(Reading(cause, fix, poses, rank + 1))
    return found


def angles(given: PoseSet, convention: Convention) -> list[Reading]:
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
                    what = ["in another order"] * (order != (0, 1, 2))
                    what += ["of another sign"] * (-1 in signs)
                    what += ["counted from another zero"] * (zero != 0)
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


def _split_xyz(matrix: Array) -> Array:
    """(N, 3) omega, phi and kappa of Rx(omega) Ry(phi) Rz(kappa)."""
    omega = np.arctan2(-matrix[:, 1, 2], matrix[:, 2, 2])
    phi = np.arcsin(np.clip(matrix[:, 0, 2], -1, 1))
    kappa = np.arctan2(-matrix[:, 0, 1], matrix[:, 0, 0])
    return np.column_stack([omega, phi, kappa])


def _turns(angles: Array, axes: Sequence[int]) -> Array:
    parts = []
    for k, axis in enumerate(axes):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        part = np.tile(np.eye(3), (len(angles), 1, 1))
        part[:, i, i] = part[:, j, j] = np.cos(angles[:, k])
        part[:, j, i] = np.sin(angles[:, k])
        part[:, i, j] = -part[:, j, i]
        parts.append(part)
    return np.asarray(parts[0] @ parts[1] @ parts[2])


_EULER: dict[str, tuple[Callable[[Array], Array], Callable[[Array], Array]]] = {
    "heading, pitch, roll": (_split_zxy, lambda angles: _turns(angles * (-1, 1, 1), (2, 0, 1))),
    "omega, phi, kappa": (_split_xyz, lambda angles: _turns(angles, (0, 1, 2))),
}
