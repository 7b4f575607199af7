"""Continuity of sequences: frames of a video, and photographs taken in quick succession."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence, Set
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.plan.sequence import why_ordered
from pipeline.scene.manifest import Photo

Names = tuple[str, str]

# A step of a sequence is broken if the camera turns by more than this angle, and by more than
# this multiple of the median turn between neighbours.
MIN_BREAK_DEG = 45.0
BREAK_RATIO = 5.0
# The number of photographs on each side of a step that are tested for a verified pair across it.
REACH = 3


def sequence_steps(photos: Sequence[Photo]) -> list[Names]:
    """The names of neighbours in the scene's sequences, in order: frames of one video, or
    photographs that ``why_ordered`` calls a sequence."""
    groups: dict[str, list[Photo]] = {}
    for photo in sorted(photos, key=lambda photo: photo.name):
        folder = photo.name.rpartition("/")[0]
        is_frame = bool(folder) and photo.camera_group.startswith(f"{folder} ")
        is_frame &= re.fullmatch(r"\d+\.png", photo.name.rpartition("/")[2]) is not None
        groups.setdefault(folder if is_frame else "", []).append(photo)
    steps: list[Names] = []
    for folder, members in groups.items():
        if folder or why_ordered(members):
            steps += pairwise(photo.name for photo in members)
    return steps


def broken_steps(
    rotations: Mapping[str, NDArray[np.float64]],
    agrees: Callable[[Names], bool | None],
    steps: Sequence[Names],
) -> list[Names]:
    """The steps at which a model turns the camera far more than the sequence does.

    A step leads from one registered photograph to the next. It is broken if most of the verified
    pairs across it contradict the turn: without pairs it is a cut, and with pairs that agree the
    camera turned. A single stray photograph breaks no step, nor does one at an end of the sequence.

    Args:
        rotations: Name -> (3, 3) world to camera, of the registered photographs.
        agrees: The names of two photographs -> whether the matches of the pair agree with the
            model; None without a two-view geometry.
        steps: The result of ``sequence_steps``.
    """
    known = _between_known(steps, rotations.keys())
    turns = np.array([_turn(rotations[a], rotations[b]) for a, b in known])
    if len(turns) == 0:
        return []
    limit = max(MIN_BREAK_DEG, BREAK_RATIO * float(np.median(turns)))
    before = {b: a for a, b in known}
    after = dict(known)

    def around(name: str, link: Mapping[str, str]) -> list[str]:
        found = [name]
        while len(found) < REACH and (following := link.get(found[-1])):
            found.append(following)
        return found

    def is_broken(a: str, b: str) -> bool:
        if a not in before or b not in after:
            return False
        outer = _turn(rotations[before[a]], rotations[after[b]])
        firsts, seconds = around(a, before), around(b, after)
        across = [agrees((x, y)) for x in firsts for y in seconds]
        return outer > limit and across.count(True) < across.count(False)

    return [
        step for step, turn in zip(known, turns, strict=True) if turn > limit and is_broken(*step)
    ]


def _between_known(steps: Sequence[Names], known: Set[str]) -> list[Names]:
    """The steps from one known photograph to the next, across those that are not."""
    found: list[Names] = []
    last: dict[str, str] = {}
    for a, b in steps:
        start = a if a in known else last.get(a)
        if start is not None and b in known:
            found.append((start, b))
        elif start is not None:
            last[b] = start
    return found


def _turn(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """The angle between two rotations, degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(a @ b.T) - 1) / 2, -1, 1))))
