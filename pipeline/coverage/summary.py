"""Viewpoints as sentences for the person with the camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.coverage.probe_views import Doubles, Eye, look_for
from pipeline.coverage.viewpoints import STEEP, Viewpoint

#: Steps shorter than this share of the distance to the subject are not worth words.
_SMALL = 0.08
#: Cameras on two sides of a place stand at least so many degrees apart, seen from above it...
_BETWEEN = 120.0
#: ...and no farther away than this many times the nearer one.
_FARTHER = 4.0


def describe(viewpoint: Viewpoint, eyes: Sequence[Eye], up: Doubles, unit: str | None) -> str:
    """Where to stand and what to look at, told by photographs that there are.

    Args:
        eyes: of the photographs.
        up: (3,) the world's.
        unit: of the world's lengths, None where it has none: then lengths are told as shares of the
            distance to the subject.
    """
    place = viewpoint.view.centre
    centres = np.stack([eye.view.centre for eye in eyes])
    distance = np.linalg.norm(centres - place, axis=1)
    order = np.argsort(distance, kind="stable")
    first = int(order[0])
    second = _opposite(_level(centres - place, up), order)
    name = eyes[first].view.name
    start = centres[first]
    if second is None:
        text = f"from {name}"
    else:
        text = f"between {name} and {eyes[second].view.name}"
        along = centres[second] - start
        level = _level(along, up)
        start = start + along * float((place - start) @ level / (level @ level))
    right, ahead = _heading(eyes[first], up)
    step = place - start
    steps = [
        _step(float(step @ up), "higher", "lower", viewpoint.distance, unit),
        _step(float(step @ right), "to the right", "to the left", viewpoint.distance, unit),
        _step(float(step @ ahead), "ahead", "back", viewpoint.distance, unit),
    ]
    moves = ", ".join(words for words in steps if words)
    if moves and unit is None:
        moves += " (of the distance to the subject)"
    shown = _shows(viewpoint.subject, eyes)
    looking = f", looking at what {shown} shows in its middle" if shown else ""
    return f"{text}{', ' + moves if moves else ''}{looking}"


def _opposite(offsets: Doubles, order: NDArray[np.intp]) -> int | None:
    """The nearest camera on the other side of a place than the nearest one.

    Args:
        offsets: (N, 3) level, from the place to the cameras. order: the cameras, nearest first.
    """
    first = offsets[order[0]]
    distance = np.linalg.norm(offsets, axis=1)
    for i in map(int, order[1:]):
        both = distance[order[0]] * distance[i]
        if distance[i] > _FARTHER * distance[order[0]] or both == 0:
            continue
        if first @ offsets[i] / both < np.cos(np.radians(_BETWEEN)):
            return i
    return None


def _level(vectors: Doubles, up: Doubles) -> Doubles:
    return np.asarray(vectors - (vectors @ up)[..., None] * up)


def _heading(eye: Eye, up: Doubles) -> tuple[Doubles, Doubles]:
    """Level unit vectors to the right and ahead of a camera."""
    rotation = eye.view.world_to_camera[:3, :3]
    ahead = rotation[2] if abs(float(rotation[2] @ up)) < STEEP else -rotation[1]
    ahead = _level(ahead, up)
    ahead = ahead / np.linalg.norm(ahead)
    return np.cross(ahead, up), ahead


def _step(length: float, more: str, less: str, distance: float, unit: str | None) -> str:
    if abs(length) < _SMALL * distance:
        return ""
    words = more if length > 0 else less
    if unit is None:
        return f"{abs(length) / distance:.0%} {words}"
    return f"{abs(length):.2g} {unit} {words}"


def _shows(subject: Doubles, eyes: Sequence[Eye]) -> str | None:
    """The photograph that has a point nearest to its middle; None where none sees it."""
    best, name = np.inf, None
    for eye in eyes:
        view = eye.view
        if not len(look_for(eye, subject[None], np.zeros(1, bool)).seen):
            continue
        x, y, z = view.world_to_camera[:3, :3] @ (subject - view.centre)
        off = np.hypot(
            (view.fx * x / z + view.cx) / view.width - 0.5,
            (view.fy * y / z + view.cy) / view.height - 0.5,
        )
        if off < best:
            best, name = float(off), view.name
    return name
