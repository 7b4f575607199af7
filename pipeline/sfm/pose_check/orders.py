"""Other readings of which photograph a given pose belongs to."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.sfm.pose_check.conventions import PoseSet, Reading


def orders(given: PoseSet, names: Sequence[str], rank: int = 1) -> list[Reading]:
    """Poses of the neighbouring photograph, in reverse, or in the other order of numbers."""
    count = len(given)
    orders: list[tuple[str, NDArray[np.int64]]] = []
    for step in (1, -1, 2, -2, 3, -3):
        if abs(step) < count:
            places = f"{abs(step)} " if abs(step) > 1 else ""
            text = f"{places}{'after' if step > 0 else 'before'} it"
            order = np.roll(np.arange(count), step)
            orders.append((f"each photograph has the pose of the one {text}", order))
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
