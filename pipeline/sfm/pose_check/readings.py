"""Other readings of given poses: the mistakes that people make when they write pose files.

Each reading changes the given poses or cameras as if the file followed another convention than its
format's. Which one is right is decided by the photographs' own matches (``check``).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.io.poses.kinds import PoseKind
from pipeline.sfm.pose_check.angles import angles, quaternions
from pipeline.sfm.pose_check.conventions import (
    ANGLES,
    COLMAP,
    CONVENTIONS,
    NAMED,
    OPENGL,
    TRANSLATIONS,
    Convention,
    Direction,
    PoseSet,
    Position,
    Reading,
    explained,
    signed_axes,
    signed_permutations,
)
from pipeline.sfm.pose_check.intrinsics import intrinsics
from pipeline.sfm.pose_check.orders import orders

Array = NDArray[np.float64]


def turned_readings(given: PoseSet, kind: PoseKind) -> list[Reading]:
    """The readings of other axes and directions that are common: those that fit as well as the
    right one if the cameras move in a line without turning."""
    return [r for r in interpretations(given, CONVENTIONS[kind]) if r.rank <= 2]


def readings(given: PoseSet, kind: PoseKind, names: Sequence[str]) -> Iterator[Reading]:
    """All other readings of poses that were read as of ``kind``.

    Args:
        names: The photographs in the order of ``given``.
    """
    convention = CONVENTIONS[kind]
    simple = [
        *interpretations(given, convention),
        *quaternions(given, convention),
        *orders(given, names),
        *intrinsics(given),
    ]
    if kind in ANGLES:
        simple += angles(given, convention)
    yield from simple
    if convention.position == "centre":
        # COLMAP's translations beside rotations that were converted to the format's axes.
        centres = -np.einsum("nji,nj->ni", given.rotations, given.centres)
        yield Reading(*TRANSLATIONS, given.posed(given.rotations, centres), 2)
    yield from _positions(given)
    for axes in _two_mistakes(given, convention):
        yield from (
            replace(second, cause=f"{axes.cause}; {second.cause}", fix=f"{axes.fix}; {second.fix}")
            for second in (
                *orders(axes.poses, names, 4),
                *intrinsics(axes.poses, 4, coarse=True),
            )
        )


def translation_centres(given: PoseSet, kind: PoseKind) -> Array:
    """(N, 3) the numbers that a file of ``kind`` would have if it had the other kind of position:
    the cameras' centres if what is there are translations, or the opposite."""
    convention = CONVENTIONS[kind]
    is_translation = convention.position == "translation"
    return convention.raw(given)[1] if is_translation else given.translations


def interpretations(given: PoseSet, convention: Convention) -> list[Reading]:
    """Other axes, directions of the rotation and meanings of the position."""
    rotations, positions = convention.raw(given)
    found = []
    directions: tuple[Direction, ...] = ("camera to world", "world to camera")
    meanings: tuple[Position, ...] = ("centre", "translation")
    for direction, meaning in itertools.product(directions, meanings):
        for axes in signed_permutations():
            other = Convention(direction, meaning, axes)
            same = np.array_equal(axes, convention.axes)
            changes = (direction != convention.rotation, meaning != convention.position, not same)
            if not any(changes):
                continue
            cause, fix = explained(convention, other)
            named = any(np.array_equal(axes, matrix) for matrix, _ in NAMED)
            rank = (0 if changes[0] == changes[1] else 1) + (0 if same else 1 if named else 3)
            poses = other.read(given, rotations, positions)
            found.append(Reading(cause, fix, poses, rank))
    return found


def _positions(given: PoseSet) -> list[Reading]:
    """Positions whose world has other axes than that of the rotations."""
    found = []
    for axes in signed_permutations():
        if np.array_equal(axes, np.eye(3)):
            continue
        mirrored = ", mirrored" if np.linalg.det(axes) < 0 else ""
        cause = (
            "the positions and the rotations look like those of worlds with different axes "
            f"({', '.join(signed_axes(axes, 'xyz'))} for x, y, z{mirrored})"
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
            cause, fix = explained(convention, other)
            if cause:
                yield Reading(cause, fix, other.read(given, rotations, positions), 4)
