"""Descriptions of viewpoints for the photographer, relative to existing photographs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.coverage.probe_views import Doubles, ProbeView, find_visible
from pipeline.coverage.viewpoints import STEEP_COSINE, Viewpoint
from pipeline.scene.views import View

#: Offsets below this share of the subject distance are not described.
_MIN_OFFSET = 0.08
#: A viewpoint is "between" two cameras if their directions from it, seen from above, differ by at
#: least this angle in degrees...
_MIN_BETWEEN_DEG = 120.0
#: ...and the farther one is at most this many times as far away as the nearer one.
_MAX_DISTANCE_RATIO = 4.0


def describe(
    viewpoint: Viewpoint, probes: Sequence[ProbeView], up: Doubles, unit: str | None
) -> str:
    """The position of a viewpoint as steps from existing photographs, and its viewing target.

    Args:
        probes: The probe views of the photographs.
        up: (3,) up vector of the world.
        unit: The name of the unit of length. None: lengths are given as percentages of the distance
            to the subject.
    """
    place = viewpoint.view.centre
    centres = np.stack([probe.view.centre for probe in probes])
    distance = np.linalg.norm(centres - place, axis=1)
    order = np.argsort(distance, kind="stable")
    first = int(order[0])
    second = _opposite(_horizontal(centres - place, up), order)
    name = probes[first].view.name
    start = centres[first]
    if second is None:
        text = f"from {name}"
    else:
        text = f"between {name} and {probes[second].view.name}"
        along = centres[second] - start
        level = _horizontal(along, up)
        start = start + along * float((place - start) @ level / (level @ level))
    right, ahead = heading(probes[first].view, up)
    step = place - start
    steps = [
        _step(float(step @ up), "higher", "lower", viewpoint.distance, unit),
        _step(float(step @ right), "to the right", "to the left", viewpoint.distance, unit),
        _step(float(step @ ahead), "ahead", "back", viewpoint.distance, unit),
    ]
    moves = ", ".join(part for part in steps if part)
    if moves and unit is None:
        moves += " (of the distance to the subject)"
    target = _most_central(viewpoint.subject, probes)
    looking = f", looking at what {target} shows in its middle" if target else ""
    return f"{text}{', ' + moves if moves else ''}{looking}"


def _opposite(offsets: Doubles, order: NDArray[np.intp]) -> int | None:
    """Index of the nearest camera on the side of a place opposite to the nearest camera.

    Args:
        offsets: (N, 3) horizontal vectors from the place to the cameras.
        order: The indices of the cameras, nearest first.
    """
    first = offsets[order[0]]
    distance = np.linalg.norm(offsets, axis=1)
    for i in map(int, order[1:]):
        both = distance[order[0]] * distance[i]
        if distance[i] > _MAX_DISTANCE_RATIO * distance[order[0]] or both == 0:
            continue
        if first @ offsets[i] / both < np.cos(np.radians(_MIN_BETWEEN_DEG)):
            return i
    return None


def _horizontal(vectors: Doubles, up: Doubles) -> Doubles:
    return np.asarray(vectors - (vectors @ up)[..., None] * up)


def heading(view: View, up: Doubles) -> tuple[Doubles, Doubles]:
    """Horizontal unit vectors to the right of and ahead of a camera."""
    rotation = view.world_to_camera[:3, :3]
    ahead = rotation[2] if abs(float(rotation[2] @ up)) < STEEP_COSINE else -rotation[1]
    ahead = _horizontal(ahead, up)
    ahead = ahead / np.linalg.norm(ahead)
    return np.cross(ahead, up), ahead


def _step(length: float, more: str, less: str, distance: float, unit: str | None) -> str:
    if abs(length) < _MIN_OFFSET * distance:
        return ""
    direction = more if length > 0 else less
    if unit is None:
        return f"{abs(length) / distance:.0%} {direction}"
    return f"{abs(length):.2g} {unit} {direction}"


def _most_central(subject: Doubles, probes: Sequence[ProbeView]) -> str | None:
    """Name of the photograph that shows a point nearest to its centre; None if none shows it."""
    best, name = np.inf, None
    for probe in probes:
        view = probe.view
        if not len(find_visible(probe, subject[None], np.zeros(1, bool)).visible):
            continue
        x, y, z = view.world_to_camera[:3, :3] @ (subject - view.centre)
        off = np.hypot(
            (view.fx * x / z + view.cx) / view.width - 0.5,
            (view.fy * y / z + view.cy) / view.height - 0.5,
        )
        if off < best:
            best, name = float(off), view.name
    return name
