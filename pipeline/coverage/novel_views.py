"""Novel views: places beside the photographs where one may walk, at which no test view stands."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from pipeline.coverage.defects import MIN_AGREEING, NEAR_SHARE
from pipeline.coverage.probe_views import Bools, Doubles
from pipeline.coverage.summary import heading
from pipeline.coverage.training_views import SurfaceSample, TrainingViews
from pipeline.coverage.viewpoints import features, subject_distance
from pipeline.geometry.rotations import quat_to_rotation, rotation_from_vector, rotation_to_quat
from pipeline.scene.views import View, evenly_spaced

Kind = Literal["between", "beside", "behind", "raised"]
#: Halfway to the nearest camera; to one side; backwards; upwards, looking at the same subject.
KINDS: tuple[Kind, ...] = get_args(Kind)
#: Number of cameras that are moved, evenly spaced.
MAX_CAMERAS = 6
#: Moves, in shares of the distance from the camera to its subject.
BESIDE, BEHIND, RAISED = 0.3, 0.35, 0.3
#: Cameras whose viewing directions differ by more than acos(this) are not neighbours.
NEIGHBOUR_COSINE = 0.5
#: On the way to a place, one stays at least this far from the surface that training views show, in
#: the same unit, or half as far as the camera itself: surfaces go on a little beyond the
#: photographs, and one does not look at a wall from inside.
CLEARANCE = 0.2


@dataclass(frozen=True)
class NovelView:
    """A camera without a photograph, near a training view.

    Attributes:
        kind: How it was moved.
        base: The training view.
        view: The moved camera. Its name and files are those of the training view.
        distance: The distance from the training view to its subject, world units.
    """

    kind: Kind
    base: View
    view: View
    distance: float


def choose_novel_views(training: TrainingViews, up: Doubles) -> list[NovelView]:
    """Up to one novel view of each kind around each of up to ``MAX_CAMERAS`` cameras, at free
    places; ordered by camera.

    Args:
        up: (3,) up vector of the world.
    """
    chosen: dict[tuple[str, Kind], NovelView] = {}
    for novel in free_novel_views(training, up, MAX_CAMERAS):
        chosen.setdefault((novel.base.name, novel.kind), novel)
    return list(chosen.values())


def free_novel_views(training: TrainingViews, up: Doubles, cameras: int) -> Iterator[NovelView]:
    """All novel views at free places around up to so many cameras, ordered by camera.

    Args:
        up: (3,) up vector of the world.
    """
    surface = training.surface.xyz[_is_surface(training.surface)]
    return (novel for novel in _candidates(training, up, cameras) if _is_free(novel, surface))


def _candidates(training: TrainingViews, up: Doubles, cameras: int) -> Iterator[NovelView]:
    """Novel views by camera and kind, with that to be preferred first: left and right alternate."""
    distances = np.array([subject_distance(probe) for probe in training.probes])
    if not (distances > 0).any():
        return
    scale = float(np.median(distances[distances > 0]))
    described = np.stack([features(view, scale) for view in training.views])
    pairs: set[frozenset[int]] = set()
    usable = [i for i, distance in enumerate(distances) if distance > 0]
    for number, i in enumerate(evenly_spaced(usable, cameras)):
        view, distance = training.views[i], float(distances[i])
        rotation, centre = view.world_to_camera[:3, :3], view.centre
        right, ahead = heading(view, up)
        j = _neighbour(described, i)
        moved: list[tuple[Kind, View]] = []
        if j is not None and {i, j} not in pairs:
            pairs.add(frozenset((i, j)))
            moved.append(("between", _halfway(view, training.views[j])))
        for side in (1, -1) if number % 2 == 0 else (-1, 1):
            beside = centre + side * BESIDE * distance * right
            moved.append(("beside", _posed(view, rotation, beside)))
        moved.append(("behind", _posed(view, rotation, centre - BEHIND * distance * ahead)))
        moved.append(("raised", _raised(view, distance, up)))
        for kind, novel in moved:
            yield NovelView(kind, view, novel, distance)


def _is_free(novel: NovelView, surface: Doubles) -> bool:
    """Whether one can go straight from the camera to the place."""
    start, end = novel.base.centre, novel.view.centre
    limit = min(CLEARANCE * novel.distance, _clearance(start, start, surface) / 2)
    return _clearance(start, end, surface) > limit


def _is_surface(sample: SurfaceSample) -> Bools:
    """(N,) False for floaters: points that two views see past, or that one view alone shows, nearer
    than half the distance of the nearest surface."""
    agreed = (sample.count >= MIN_AGREEING) | (sample.depth >= NEAR_SHARE * sample.nearest)
    return np.asarray(agreed & (sample.seen_past < MIN_AGREEING))


def _clearance(start: Doubles, end: Doubles, surface: Doubles) -> float:
    """The distance of a straight line from the nearest of (N, 3) points."""
    along, offset = end - start, surface - start
    share = (offset * along).sum(axis=1) / max(float((along**2).sum()), 1e-30)
    nearest = share.clip(0, 1)[:, None] * along
    return float(np.sqrt(((offset - nearest) ** 2).sum(axis=1).min(initial=np.inf)))


def _neighbour(described: Doubles, i: int) -> int | None:
    """The camera nearest to camera ``i`` in place and direction, None without one."""
    distance = np.linalg.norm(described - described[i], axis=1)
    distance[described[:, 3:] @ described[i, 3:] < NEIGHBOUR_COSINE] = np.inf
    distance[i] = np.inf
    best = int(distance.argmin())
    return best if np.isfinite(distance[best]) else None


def _halfway(view: View, other: View) -> View:
    """The view halfway to another one: the mean place, and the rotation by spherical linear
    interpolation, which is the normalised mean of the quaternions."""
    a, b = (rotation_to_quat(v.world_to_camera[:3, :3]) for v in (view, other))
    rotation = quat_to_rotation(a + b if a @ b >= 0 else a - b)
    return _posed(view, rotation, (view.centre + other.centre) / 2)


def _raised(view: View, distance: float, up: Doubles) -> View:
    """The view moved up, turned so that its optical axis meets the same subject."""
    rotation = view.world_to_camera[:3, :3]
    centre = view.centre + RAISED * distance * up
    ahead = view.centre + distance * rotation[2] - centre
    ahead /= np.linalg.norm(ahead)
    axis = np.cross(rotation[2], ahead)
    sine = float(np.linalg.norm(axis))
    if sine > 1e-9:
        angle = float(np.arctan2(sine, rotation[2] @ ahead))
        rotation = rotation @ rotation_from_vector(axis / sine * angle).T
    return _posed(view, rotation, centre)


def _posed(view: View, rotation: Doubles, centre: Doubles) -> View:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    return replace(view, mask=None, world_to_camera=pose)
