"""Viewpoints to photograph next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.coverage.probe_views import (
    Bools,
    Doubles,
    Draw,
    Eye,
    Points,
    look_for,
    open_eyes,
    points_of,
)
from pipeline.coverage.trust import gather, trust
from pipeline.runtime.progress import track
from pipeline.scene.views import View

COUNT = 5
#: A viewpoint that would raise the mean trust of its surroundings by less is not worth the way.
MIN_GAIN = 0.002
#: So many cameras are moved about, and so many of the viewpoints that this gives are judged.
MAX_BASES, MAX_CANDIDATES = 40, 64
#: How, in degrees: around what the camera shows, and above.
MOVES = tuple((a, e) for a in (-40, -20, 0, 20, 40) for e in (-20, -10, 0, 10, 20) if a or e)
#: Cameras that look steeper up or down than this are moved about their picture's column.
STEEP = 0.8
#: Viewpoints go so far above and below the cameras as these spread in height, or this share of
#: their usual distance to what they show: who photographed on foot has no ladder.
HEIGHT_MARGIN = 0.1
#: Where no photograph shows whether there is room, a viewpoint stays this near to a camera, as a
#: share of its distance to what it shows.
BLIND_REACH = 0.4
#: Surfaces nearer than this share of that distance, in a tenth of the picture, leave no room.
MIN_ROOM = 0.25
#: Viewpoints where more of the rays meet no surface show nothing that can be judged.
MAX_OPEN = 0.7
#: Nearer to a photograph than this it would be the same photograph; see ``_features``.
SAME = 0.15
#: Each this-many-th pixel of each this-many-th row is judged.
STEP = 6


@dataclass(frozen=True)
class Viewpoint:
    """Where a photograph could be taken.

    Attributes:
        view: its camera, at the size of the photographs.
        subject: (3,) the point of the world that it looks at.
        distance: from there, world unit.
    """

    view: View
    subject: Doubles
    distance: float


@dataclass(frozen=True)
class Proposal:
    """A viewpoint to photograph.

    Attributes:
        viewpoint: where.
        eye: what the trained scene shows there.
        unknown: 1 minus the mean trust of that, given the proposals before it.
        gain: rise of the mean trust of all judged viewpoints, given the proposals before it.
    """

    viewpoint: Viewpoint
    eye: Eye
    unknown: float
    gain: float


@dataclass(frozen=True)
class Outlook:
    """What is known of the surroundings of the photographs, and what would add to it.

    Attributes:
        proposals: what adds most, first.
        judged: all viewpoints around the photographs that were thought of.
        before, after: mean trust of what these show, now and with the proposals.
    """

    proposals: list[Proposal]
    judged: list[Viewpoint]
    before: float
    after: float


def propose(
    views: Sequence[View],
    eyes: Sequence[Eye],
    draw: Draw,
    up: Doubles,
    beyond: float,
    threads: int = 1,
) -> Outlook:
    """Viewpoints that together raise the trust most, each after those before it.

    Cameras are moved around what they show, by up to 40 degrees, and above and below by up to 20.
    Of the viewpoints that this gives, those where there is room are thinned evenly; what they show
    of surfaces is judged. One after the other, the one is proposed that adds most to the mean trust
    of all of it, if the surface is where the scene has it now. (Greedy, as for coverage in general:
    Nemhauser et al. 1978, "An analysis of approximations for maximizing submodular set functions".)

    Args:
        views: the photographs' cameras, at their own size. eyes: the same, in the same order.
        up: (3,) the world's.
        beyond: depth to take where a ray meets no surface, world unit.
        threads: viewpoints rendered at a time.
    """
    viewpoints, opened = _with_sight(_around(views, eyes, up), draw, threads)
    if not viewpoints:
        return Outlook([], [], 0.0, 0.0)
    points, owner = _surfaces(opened, beyond)
    evidence = gather(track(eyes, "judging viewpoints", len(eyes), unit="views"), points)
    sightings = [look_for(eye, points.xyz, points.open) for eye in opened]
    # Each viewpoint counts the same, however much of its picture is surface.
    weight = 1 / np.bincount(owner, minlength=len(opened))[owner] / len(opened)
    known = trust(evidence.information, evidence.support, points.towards)
    # Sums, not products of vectors: BLAS sums by the number of threads.
    before = float((weight * known).sum())
    left, proposals = set(range(len(opened))), list[Proposal]()
    while left and len(proposals) < COUNT:
        gains = np.full(len(opened), -np.inf)
        for i in left:
            seen = sightings[i].seen
            grown = trust(*evidence.gained(sightings[i], points), points.towards[seen])
            gains[i] = (weight[seen] * (grown - known[seen])).sum()
        best = int(gains.argmax())
        if gains[best] < MIN_GAIN:
            break
        unknown = 1 - float(known[owner == best].mean())
        proposals.append(Proposal(viewpoints[best], opened[best], unknown, float(gains[best])))
        left.remove(best)
        evidence.add(sightings[best], points)
        known = trust(evidence.information, evidence.support, points.towards)
    return Outlook(proposals, viewpoints, before, float((weight * known).sum()))


def _surfaces(eyes: Sequence[Eye], beyond: float) -> tuple[Points, NDArray[np.intp]]:
    """Points of the surfaces that cameras show, and the index of the camera of each."""
    parts = [points_of(eye, beyond, STEP) for eye in eyes]
    joined = [np.concatenate([getattr(part, name) for part in parts]) for name in _FIELDS]
    owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    met = ~joined[1]
    return Points(*(values[met] for values in joined)), owner[met]


_FIELDS = ("xyz", "open", "towards", "sharpness")


def _around(views: Sequence[View], eyes: Sequence[Eye], up: Doubles) -> list[Viewpoint]:
    """Viewpoints near cameras where there is room, evenly spread and not too many."""
    distances = np.array([subject_distance(eye) for eye in eyes])
    usual = float(np.median(distances[distances > 0])) if (distances > 0).any() else 0.0
    if usual == 0:
        return []
    taken = np.stack([_features(view, usual) for view in views])
    bases = _spread(taken, MAX_BASES, np.full(len(taken), np.inf))
    moved = [
        _moved(views[i], float(distances[i]), up, *move)
        for i in sorted(bases)
        if distances[i] > 0
        for move in MOVES
    ]
    height = np.stack([view.centre for view in views]) @ up
    margin = max(float(np.ptp(height)), HEIGHT_MARGIN * usual)
    low, high = height.min() - margin, height.max() + margin
    moved = [item for item in moved if low <= item.view.centre @ up <= high]
    moved = [item for item, room in zip(moved, _room(moved, eyes, up), strict=True) if room]
    if not moved:
        return []
    features = np.stack([_features(viewpoint.view, usual) for viewpoint in moved])
    apart = np.min([np.linalg.norm(features - other, axis=1) for other in taken], axis=0)
    return [moved[i] for i in _spread(features, MAX_CANDIDATES, apart)]


def subject_distance(eye: Eye) -> float:
    """Median depth of the middle of a camera's picture; 0 where there is no surface."""
    height, width = eye.depth.shape
    middle = eye.depth[height // 3 : height - height // 3, width // 3 : width - width // 3]
    met = middle[np.isfinite(middle)]
    return float(np.median(met)) if len(met) else 0.0


def _moved(view: View, distance: float, up: Doubles, around: float, above: float) -> Viewpoint:
    rotation = view.world_to_camera[:3, :3]
    axis = up if abs(float(rotation[2] @ up)) < STEEP else -rotation[1]
    subject = view.centre + distance * rotation[2]
    offset = view.centre - subject
    turn = _rotation(axis, around) @ _rotation(np.cross(offset, axis), above)
    centre = subject + turn @ offset
    pose = np.eye(4)
    pose[:3, :3] = rotation @ turn.T
    pose[:3, 3] = -pose[:3, :3] @ centre
    moved = replace(view, mask=None, world_to_camera=pose)
    return Viewpoint(moved, subject, distance)


def _rotation(axis: Doubles, degrees: float) -> Doubles:
    """(3, 3) rotation about an axis: Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def _features(view: View, usual: float) -> Doubles:
    """(6,) place, in the photographs' usual distances to what they show, and direction."""
    return np.concatenate([view.centre / usual, view.world_to_camera[2, :3]])


def _spread(features: Doubles, count: int, apart: Doubles) -> list[int]:
    """Indices of up to ``count`` rows, each the farthest from those before it.

    Args:
        apart: (N,) distances from what is there already; rows nearer than ``SAME`` are left out.
    """
    chosen: list[int] = []
    while len(chosen) < min(count, len(features)):
        best = int(apart.argmax())
        if apart[best] < SAME:
            break
        chosen.append(best)
        apart = np.minimum(apart, np.linalg.norm(features - features[best], axis=1))
    return chosen


def _room(viewpoints: Sequence[Viewpoint], eyes: Sequence[Eye], up: Doubles) -> Bools:
    """(N,) True where a photograph sees past the place; where none looks there, if a camera is near
    and not all are higher: people do not stand below ground."""
    xyz = np.array([viewpoint.view.centre for viewpoint in viewpoints]).reshape(-1, 3)
    reach = BLIND_REACH * np.array([viewpoint.distance for viewpoint in viewpoints])
    free, hidden, near = np.zeros((3, len(xyz)), bool)
    for eye in eyes:
        sighting = look_for(eye, xyz, np.zeros(len(xyz), bool))
        free |= sighting.passed
        hidden |= sighting.hidden
        hidden[sighting.seen] = True
        near |= np.linalg.norm(xyz - eye.view.centre, axis=1) <= reach
    lowest = min(float(eye.view.centre @ up) for eye in eyes)
    return np.asarray(free | (near & ~hidden & (xyz @ up >= lowest)))


def _with_sight(
    viewpoints: list[Viewpoint], draw: Draw, threads: int
) -> tuple[list[Viewpoint], list[Eye]]:
    """Those that have sight of something, and what they see."""
    kept: list[Viewpoint] = []
    eyes: list[Eye] = []
    opened = open_eyes([viewpoint.view for viewpoint in viewpoints], draw, threads)
    opened = track(opened, "looking around", len(viewpoints), unit="viewpoints")
    for viewpoint, eye in zip(viewpoints, opened, strict=True):
        nearest = np.percentile(np.where(eye.open, 1e30, eye.depth), 10)
        if eye.open.mean() <= MAX_OPEN and nearest >= MIN_ROOM * viewpoint.distance:
            kept.append(viewpoint)
            eyes.append(eye)
    return kept, eyes
