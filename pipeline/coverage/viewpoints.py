"""Next best views: viewpoints from which further photographs raise the trust most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.coverage.probe_views import (
    Bools,
    Doubles,
    ProbeView,
    QueryPoints,
    Renderer,
    backproject,
    find_visible,
    render_probes,
)
from pipeline.coverage.trust import collect_observations, trust
from pipeline.runtime.progress import track
from pipeline.scene.views import View

#: Largest number of proposals.
MAX_PROPOSALS = 5
#: A proposal raises the mean trust of all candidates by at least this.
MIN_GAIN = 0.002
#: Largest numbers of cameras that are moved to make candidates, and of candidates.
MAX_BASES, MAX_CANDIDATES = 40, 64
#: Moves of a camera around its subject: azimuth and elevation, degrees.
ORBIT_MOVES = tuple((a, e) for a in (-40, -20, 0, 20, 40) for e in (-20, -10, 0, 10, 20) if a or e)
#: A camera whose viewing direction is within acos(this) of vertical orbits about its image's
#: vertical axis, not about the world's.
STEEP_COSINE = 0.8
#: Candidates may exceed the cameras' range of heights by that range, or by this share of the
#: median subject distance if that is more.
HEIGHT_MARGIN = 0.1
#: Candidates at places that no photograph shows to be free lie within this share of their subject
#: distance from a camera.
BLIND_REACH = 0.4
#: A candidate is dropped if a tenth of its pixels show surfaces nearer than this share of its
#: subject distance...
MIN_CLEARANCE = 0.25
#: ...or if more than this share of its rays meets no surface.
MAX_EMPTY = 0.7
#: Least distance between two candidates, or a candidate and a photograph, in ``features``.
MIN_SEPARATION = 0.15
#: Stride of the evaluated pixels of a candidate.
PIXEL_STEP = 6


@dataclass(frozen=True)
class Viewpoint:
    """A camera pose from which a photograph could be taken.

    Attributes:
        view: The camera, at the size of the photographs.
        subject: (3,) world point on its optical axis.
        distance: The distance from the camera to the subject, world units.
    """

    view: View
    subject: Doubles
    distance: float


@dataclass(frozen=True)
class Proposal:
    """A viewpoint to photograph.

    Attributes:
        viewpoint: The camera.
        probe: The render of the trained scene from there.
        unknown: 1 - mean trust of the render, with the photographs and the earlier proposals.
        gain: By how much this proposal raises the mean trust of all candidates.
    """

    viewpoint: Viewpoint
    probe: ProbeView
    unknown: float
    gain: float


@dataclass(frozen=True)
class NextBestViews:
    """Proposals and what they were chosen from.

    Attributes:
        proposals: The proposals in the order in which they were chosen.
        candidates: All viewpoints that were evaluated.
        trust_before, trust_after: The mean trust over the candidates without and with the
            proposals.
    """

    proposals: list[Proposal]
    candidates: list[Viewpoint]
    trust_before: float
    trust_after: float


def propose_viewpoints(
    views: Sequence[View],
    probes: Sequence[ProbeView],
    render: Renderer,
    up: Doubles,
    background_depth: float,
) -> NextBestViews:
    """Choose the viewpoints that together raise the mean trust of the scene's surroundings most.

    Candidates are the photographs' cameras moved on a sphere around their subjects, by up to 40
    degrees of azimuth and 20 of elevation, if the place is free, thinned to an even spread. The
    mean trust over the surfaces that all candidates show is maximised greedily: each proposal is
    the candidate that raises it most, given the proposals before it and the surface as it is now
    (Nemhauser et al. 1978, "An analysis of approximations for maximizing submodular set
    functions").

    Args:
        views: The cameras of the photographs, at full size.
        probes: The probe views of the same cameras, in the same order.
        up: (3,) up vector of the world.
        background_depth: The depth of pixels whose ray meets no surface, world units.
    """
    candidates, shown = _render_candidates(_candidates(views, probes, up), render)
    if not candidates:
        return NextBestViews([], [], 0.0, 0.0)
    points, owner = _surfaces(shown, background_depth)
    tracked = track(probes, "evaluating viewpoints", len(probes), unit="views")
    observed = collect_observations(tracked, points)
    visibilities = [find_visible(probe, points.xyz, points.empty) for probe in shown]
    # Each candidate has the same weight, however many of its pixels show a surface.
    weight = 1 / np.bincount(owner, minlength=len(shown))[owner] / len(shown)
    current = trust(observed.information, observed.support, points.to_camera)
    # Sums, not dot products: BLAS splits those by the number of threads, which changes rounding.
    before = float((weight * current).sum())
    remaining, proposals = set(range(len(shown))), list[Proposal]()
    while remaining and len(proposals) < MAX_PROPOSALS:
        gains = np.full(len(shown), -np.inf)
        for i in remaining:
            visible = visibilities[i].visible
            raised = trust(*observed.updated(visibilities[i], points), points.to_camera[visible])
            gains[i] = (weight[visible] * (raised - current[visible])).sum()
        best = int(gains.argmax())
        if gains[best] < MIN_GAIN:
            break
        unknown = 1 - float(current[owner == best].mean())
        proposals.append(Proposal(candidates[best], shown[best], unknown, float(gains[best])))
        remaining.remove(best)
        observed.add(visibilities[best], points)
        current = trust(observed.information, observed.support, points.to_camera)
    return NextBestViews(proposals, candidates, before, float((weight * current).sum()))


def _surfaces(
    probes: Sequence[ProbeView], background_depth: float
) -> tuple[QueryPoints, NDArray[np.intp]]:
    """Surface points that probe views show, and for each the index of its probe view."""
    parts = [backproject(probe, background_depth, PIXEL_STEP) for probe in probes]
    joined = [
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("xyz", "empty", "to_camera", "resolution")
    ]
    owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    on_surface = ~joined[1]
    return QueryPoints(*(values[on_surface] for values in joined)), owner[on_surface]


def _candidates(views: Sequence[View], probes: Sequence[ProbeView], up: Doubles) -> list[Viewpoint]:
    """Up to ``MAX_CANDIDATES`` viewpoints around the cameras, at free places, evenly spread."""
    distances = np.array([subject_distance(probe) for probe in probes])
    scale = float(np.median(distances[distances > 0])) if (distances > 0).any() else 0.0
    if scale == 0:
        return []
    photographed = np.stack([features(view, scale) for view in views])
    bases = _farthest_points(photographed, MAX_BASES, np.full(len(photographed), np.inf))
    moved = [
        _orbit(views[i], float(distances[i]), up, *move)
        for i in sorted(bases)
        if distances[i] > 0
        for move in ORBIT_MOVES
    ]
    height = np.stack([view.centre for view in views]) @ up
    margin = max(float(np.ptp(height)), HEIGHT_MARGIN * scale)
    low, high = height.min() - margin, height.max() + margin
    moved = [item for item in moved if low <= item.view.centre @ up <= high]
    free = _free_places(moved, probes, up)
    moved = [item for item, is_free in zip(moved, free, strict=True) if is_free]
    if not moved:
        return []
    described = np.stack([features(viewpoint.view, scale) for viewpoint in moved])
    apart = np.min([np.linalg.norm(described - other, axis=1) for other in photographed], axis=0)
    return [moved[i] for i in _farthest_points(described, MAX_CANDIDATES, apart)]


def subject_distance(probe: ProbeView) -> float:
    """Median depth of the central ninth of a probe view; 0 if it shows no surface."""
    height, width = probe.depth.shape
    centre = probe.depth[height // 3 : height - height // 3, width // 3 : width - width // 3]
    finite = centre[np.isfinite(centre)]
    return float(np.median(finite)) if len(finite) else 0.0


def _orbit(view: View, distance: float, up: Doubles, azimuth: float, elevation: float) -> Viewpoint:
    """A camera moved around its subject by two angles in degrees."""
    rotation = view.world_to_camera[:3, :3]
    axis = up if abs(float(rotation[2] @ up)) < STEEP_COSINE else -rotation[1]
    subject = view.centre + distance * rotation[2]
    offset = view.centre - subject
    turn = _rotation(axis, azimuth) @ _rotation(np.cross(offset, axis), elevation)
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


def features(view: View, scale: float) -> Doubles:
    """(6,) position, in units of the median subject distance, and viewing direction."""
    return np.concatenate([view.centre / scale, view.world_to_camera[2, :3]])


def _farthest_points(features: Doubles, count: int, apart: Doubles) -> list[int]:
    """Farthest point sampling: indices of up to ``count`` rows.

    Args:
        apart: (N,) distances to what is there already; rows nearer than ``MIN_SEPARATION`` to that
            or to a chosen row are not chosen.
    """
    chosen: list[int] = []
    while len(chosen) < min(count, len(features)):
        best = int(apart.argmax())
        if apart[best] < MIN_SEPARATION:
            break
        chosen.append(best)
        apart = np.minimum(apart, np.linalg.norm(features - features[best], axis=1))
    return chosen


def _free_places(
    viewpoints: Sequence[Viewpoint], probes: Sequence[ProbeView], up: Doubles
) -> Bools:
    """(N,) True where a photograph sees a surface behind the place; also, if no photograph shows
    the place, near a camera and not below the lowest one (which excludes places under ground)."""
    xyz = np.array([viewpoint.view.centre for viewpoint in viewpoints]).reshape(-1, 3)
    reach = BLIND_REACH * np.array([viewpoint.distance for viewpoint in viewpoints])
    free, occluded, near = np.zeros((3, len(xyz)), bool)
    for probe in probes:
        visibility = find_visible(probe, xyz, np.zeros(len(xyz), bool))
        free |= visibility.seen_past
        occluded |= visibility.occluded
        occluded[visibility.visible] = True
        near |= np.linalg.norm(xyz - probe.view.centre, axis=1) <= reach
    lowest = min(float(probe.view.centre @ up) for probe in probes)
    return np.asarray(free | (near & ~occluded & (xyz @ up >= lowest)))


def _render_candidates(
    viewpoints: list[Viewpoint], render: Renderer
) -> tuple[list[Viewpoint], list[ProbeView]]:
    """Render viewpoints; those that show too little, or too near a surface, are dropped."""
    chosen: list[Viewpoint] = []
    shown: list[ProbeView] = []
    probes = render_probes([viewpoint.view for viewpoint in viewpoints], render)
    probes = track(probes, "rendering viewpoints", len(viewpoints), unit="viewpoints")
    for viewpoint, probe in zip(viewpoints, probes, strict=True):
        nearest = np.percentile(np.where(probe.empty, 1e30, probe.depth), 10)
        if probe.empty.mean() <= MAX_EMPTY and nearest >= MIN_CLEARANCE * viewpoint.distance:
            chosen.append(viewpoint)
            shown.append(probe)
    return chosen, shown
