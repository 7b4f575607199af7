"""Comparison of given poses with the photographs' own matches, before anything expensive.

A few pairs of photographs are matched without their poses. If most matches miss the epipolar
geometry of the given poses, other readings of the file are tried (``readings``), and the
error names the one that the matches fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.epipolar import epipolar_angles
from pipeline.geometry.rays import rays
from pipeline.io.poses.kinds import PoseKind
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Photo
from pipeline.scene.reconstruction import Reconstruction
from pipeline.sfm.pose_check.conventions import PoseSet, Reading
from pipeline.sfm.pose_check.matches import (
    FeatureMatcher,
    MatchedPair,
    PairFinder,
    relative_focal,
)
from pipeline.sfm.pose_check.readings import readings, translation_centres, turned_readings

Array = NDArray[np.float64]

# Fewest pairs of photographs that the poses are judged by, and the number of pairs after which
# matching ends if they leave no doubt.
MIN_PAIRS, ENOUGH_PAIRS = 2, 4
# A reading explains the matches if this share of them is within its tolerance: this angle, or this
# share of the motion between the photographs if that is more.
_SHARE = 0.8
_TOLERANCE_DEG, _TOLERANCE_SHARE = 0.5, 0.25
# The given poses are refused for another reading if more than half of the matches miss them by
# more than this angle, and by this factor more than the angle within which the other reading
# explains them.
_REFUSED_DEG, _REFUSED_FACTOR = 0.3, 1.5
# Without another reading, they are refused if half of the matches miss them by more than this
# angle and this share of the motion: errors of phones and of surveys are smaller.
_CONTRADICTION_DEG, _CONTRADICTION_SHARE = 6.0, 0.5
# Fewer matches than this refuse poses only for other axes, directions or another order. Repeated
# structures can imitate another focal length in a few hundred matches.
_STRONG = 800
# Median angle from which poses are called inaccurate, and the percentage of matches that fit below
# which poses may be wrong.
_INACCURATE_DEG = 0.75
_FEW_FIT = 80
# Readings within this factor of the best one are as good: the simplest of them is named.
_AS_GOOD = 1.3
# Readings are compared with every fourth match first; those that miss by more than this factor of
# the tolerance are not compared with all.
_THINNED, _THINNED_FACTOR = 4, 2.0
_OVERRULE = "or set poses: ignore to estimate the poses, or poses: trust to use these unchecked"


@dataclass(frozen=True)
class PoseCheck:
    """The result of a check that does not refuse the poses: sentences for the log."""

    decisions: list[str]
    warnings: list[str]


@dataclass(frozen=True)
class _Fit:
    """How well poses fit the matches.

    Attributes:
        angles: (M,) degrees.
        half, most: The angles within which half and ``_SHARE`` of the matches are.
    """

    angles: Array
    half: float
    most: float

    @classmethod
    def of(cls, angles: Array) -> _Fit:
        half, most = np.quantile(angles, [0.5, _SHARE])
        return cls(angles, float(half), float(most))

    def percent(self, tolerance: float) -> int:
        """The share of the matches within an angle, in percent, rounded down."""
        return int(100 * (self.angles <= tolerance).mean())


class _Matches:
    """The matches of several pairs, as arrays over all of them."""

    def __init__(self, pairs: Sequence[MatchedPair], given: PoseSet) -> None:
        self.pairs, self._given = pairs, given
        counts = [len(pair.xy_one) for pair in pairs]
        self._one = np.repeat([pair.one for pair in pairs], counts)
        self._two = np.repeat([pair.two for pair in pairs], counts)
        self.motion = float(np.median([pair.motion for pair in pairs]))
        self._rays = self._rays_of(given)

    def thinned(self) -> _Matches:
        """Every ``_THINNED``-th match."""
        pairs = [
            replace(pair, xy_one=pair.xy_one[::_THINNED], xy_two=pair.xy_two[::_THINNED])
            for pair in self.pairs
        ]
        return _Matches(pairs, self._given)

    @property
    def found(self) -> int:
        return sum(pair.found for pair in self.pairs)

    @property
    def tolerance(self) -> float:
        """The angle in degrees within which a reading explains the matches."""
        return max(_TOLERANCE_DEG, _TOLERANCE_SHARE * self.motion)

    def fit(self, poses: PoseSet) -> _Fit:
        same = poses.cameras is self._given.cameras
        one, two = self._rays if same else self._rays_of(poses)
        relative = poses.rotations[self._two] @ np.swapaxes(poses.rotations[self._one], 1, 2)
        between = poses.centres[self._one] - poses.centres[self._two]
        # Rounding errors of positions far from their origin are no motion.
        between[np.linalg.norm(between, axis=1) <= 1e-12 * np.abs(poses.centres).max()] = 0.0
        translation = np.einsum("nij,nj->ni", poses.rotations[self._two], between)
        angles = np.degrees(epipolar_angles(one, two, relative, translation))
        return _Fit.of(np.minimum(angles * self._resolution(poses), 180.0))

    def _resolution(self, poses: PoseSet) -> Array:
        """(M,) the focal lengths of the second photographs relative to a nominal one, if longer.

        Angles between rays shrink as a camera's focal length grows. Multiplied by this, they are
        proportional to pixels even for the longest ones that a reading gives.
        """
        counts = [len(pair.xy_one) for pair in self.pairs]
        focals = [max(1.0, relative_focal(poses.cameras[pair.two])) for pair in self.pairs]
        return np.repeat(focals, counts)

    def _rays_of(self, poses: PoseSet) -> tuple[Array, Array]:
        ends = [(pair.one, pair.xy_one) for pair in self.pairs]
        ends += [(pair.two, pair.xy_two) for pair in self.pairs]
        # Undoing a distortion costs as much for few pixels as for many.
        alike: dict[tuple[object, ...], list[int]] = {}
        for i, (photo, _) in enumerate(ends):
            camera = poses.cameras[photo]
            key = (camera.model, camera.width, camera.height, camera.params.tobytes())
            alike.setdefault(key, []).append(i)
        found: list[Array] = [np.zeros((0, 3))] * len(ends)
        for members in alike.values():
            pixels = np.concatenate([ends[i][1] for i in members])
            all_rays = rays(poses.cameras[ends[members[0]][0]], pixels)
            splits = np.cumsum([len(ends[i][1]) for i in members])[:-1]
            for i, part in zip(members, np.split(all_rays, splits), strict=True):
                found[i] = part
        half = len(self.pairs)
        return np.concatenate(found[:half]), np.concatenate(found[half:])


def check_poses(
    model: Reconstruction,
    photos: Sequence[Photo],
    kind: PoseKind,
    source: Path,
    matcher: FeatureMatcher | None = None,
) -> PoseCheck:
    """Compare given poses with the photographs' own matches.

    Args:
        model: The given poses in the given world, with cameras of the photographs' sizes.
        photos: The photographs, sorted by name.
        kind: The format of the poses.
        source: The file of the poses, for the message.
        matcher: The source of matches; default: one for this check alone.

    Raises:
        UserError: the matches contradict the poses; the message names the reading of the file that
            they fit, if there is one.
    """
    posed = model.by_name()
    used = [photo for photo in photos if photo.name in posed and not photo.linear]
    if len(used) < 2:
        text = "the given poses could not be compared with the photographs: "
        if len(photos) < 2:
            return PoseCheck([f"{text}there is one photograph"], [])
        return PoseCheck([], [f"{text}they are RAW or EXR"])
    images = [posed[photo.name] for photo in used]
    given = PoseSet(
        np.stack([image.rotation for image in images]),
        np.stack([image.centre for image in images]),
        tuple(model.cameras[image.camera_id] for image in images),
    )
    names = [photo.name for photo in used]
    turned = turned_readings(given, kind)
    centres = np.stack([given.centres, translation_centres(given, kind)])
    pairs: list[MatchedPair] = []
    finder = PairFinder(used, given.cameras, centres, matcher or FeatureMatcher())
    for pair in finder.pairs():
        if pair is not None:
            pairs.append(pair)
            if len(pairs) < ENOUGH_PAIRS:
                continue
            if _is_clear(_Matches(pairs, given), given, turned):
                break
    if len(pairs) < MIN_PAIRS:
        text = (
            f"the given poses could not be compared with the photographs: {len(pairs)} of "
            f"{finder.tried} pairs of photographs have enough matches; look at the result's "
            "page, or set poses: trust if they are right"
        )
        return PoseCheck([], [text])
    return _verdict(_Matches(pairs, given), given, partial(readings, given, kind, names), source)


def _is_clear(matches: _Matches, given: PoseSet, turned: Sequence[Reading]) -> bool:
    """Whether the given poses explain the matches, and no reading of other axes or another
    direction does. Where cameras move in a line without turning, several do."""
    fit = matches.fit(given)
    if fit.most > min(matches.tolerance, 2 * _TOLERANCE_DEG):
        return False
    return all(matches.fit(reading.poses).half > 2 * fit.most for reading in turned)


def _verdict(
    matches: _Matches, given: PoseSet, others: Callable[[], Iterable[Reading]], source: Path
) -> PoseCheck:
    fit = matches.fit(given)
    evidence = f"{matches.found} matches between {len(matches.pairs)} pairs of photographs"
    if fit.half > _REFUSED_DEG:
        found = _best(matches, others(), fit)
        if found is not None:
            reading, better = found
            if reading.poses.cameras is not given.cameras and matches.found < _STRONG:
                return PoseCheck([], [f"{_weak(fit, evidence)}; {reading.cause}"])
            tolerance = max(_REFUSED_DEG, better.most)
            raise UserError(
                "the given poses do not agree with the photographs: "
                f"{fit.percent(tolerance)} % of {evidence} fit; {reading.cause}: then "
                f"{better.percent(tolerance)} % fit",
                file=source,
                fix=f"{reading.fix}, {_OVERRULE}",
            )
    limit = max(_CONTRADICTION_DEG, _CONTRADICTION_SHARE * matches.motion)
    agree = fit.percent(max(_REFUSED_DEG, min(matches.tolerance, 1.0)))
    if fit.half > limit and matches.found < _STRONG:
        return PoseCheck([], [_weak(fit, evidence)])
    if fit.half > limit:
        raise UserError(
            f"the given poses do not agree with the photographs: {agree} % of {evidence} fit, half "
            f"of them miss by more than {fit.half:.0f} degrees; {_placed(given)}",
            file=source,
            fix=f"check that the poses belong to these photographs, {_OVERRULE}",
        )
    if fit.half > _INACCURATE_DEG:
        text = (
            f"the given poses are inaccurate: half of {evidence} miss them by more than "
            f"{fit.half:.1f} degrees; train.refine_poses adjusts them, poses: ignore estimates "
            "them again"
        )
        return PoseCheck([], [text])
    if agree < _FEW_FIT:
        text = (
            f"the given poses may be wrong: only {agree} % of {evidence} fit them; check the focal "
            "length and the order of the photographs, or set poses: trust if they are right"
        )
        return PoseCheck([], [text])
    return PoseCheck([f"the given poses agree with {agree} % of {evidence}"], [])


def _weak(fit: _Fit, evidence: str) -> str:
    return (
        f"the given poses may be wrong: half of {evidence}, which are few, miss them by more than "
        f"{fit.half:.1f} degrees"
    )


def _placed(given: PoseSet) -> str:
    spread = np.linalg.norm(given.centres - given.centres[0], axis=1).max()
    if spread <= 1e-9 * max(1.0, float(np.abs(given.centres).max())):
        return "all cameras are in one place"
    return "no other reading of the file (axes, direction, order, intrinsics) fits either"


def _best(matches: _Matches, others: Iterable[Reading], fit: _Fit) -> tuple[Reading, _Fit] | None:
    """The simplest of the readings that explain the matches best, if they do so far better than
    the given poses."""
    few = matches.thinned()
    fits = [
        (reading, matches.fit(reading.poses))
        for reading in others
        if few.fit(reading.poses).most <= _THINNED_FACTOR * matches.tolerance
    ]
    least = min((other.most for _, other in fits), default=np.inf)
    if least > matches.tolerance or fit.half < _REFUSED_FACTOR * least:
        return None
    good = [(r, other) for r, other in fits if other.most <= max(_AS_GOOD * least, 0.1)]
    return min(good, key=lambda item: (item[0].rank, item[1].most))
