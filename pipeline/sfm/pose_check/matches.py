"""Matches of a few pairs of photographs, found without their poses, for checking given poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.geometry.epipolar import consistent_matches
from pipeline.geometry.rays import rays
from pipeline.photos.threads import one_thread_of_opencv
from pipeline.scene.manifest import Photo
from pipeline.sfm.features import CONTRAST_THRESHOLD
from pipeline.sfm.sift import DetectionImage, detect

Array = NDArray[np.float64]

MAX_SIDE_PX = 1000
MAX_FEATURES = 2000
_MAX_RATIO = 0.8
# Photographs from which pairs are sought, evenly distributed in the order of names.
ANCHORS = 10
# Matches that a pair has at least, as many and as a share of those before the verification.
MIN_MATCHES = 30
MIN_SHARE = 0.25
# Matches of a pair that are used.
MAX_USED = 150
# Distance from an epipolar line, in pixels of an image of ``MAX_SIDE_PX``.
_TOLERANCE_PX = 2.5
# Median motion between the photographs of a pair, in degrees: below the first, a pair says nothing
# about the poses; from the second, a wider pair is not sought.
MIN_MOTION = 1.0
_WIDE_MOTION = 7.0
# Steps in the order of names from an anchor to the other photograph of a pair.
_FIRST_STEPS = (1, 3, 9, 27)
# Focal lengths, divided by the longer side, at which the directions of a camera are taken from its
# given intrinsics. Others are probably wrong.
_PLAUSIBLE = (0.2, 4.0)
_NOMINAL = 0.9
# Matches that move by less than this share of the longer side, while most move farther, belong to
# what is fixed to the image: overlays, dirt, vignettes.
_FIXED = 0.004


@dataclass(frozen=True)
class MatchedPair:
    """Two photographs and their verified matches.

    Attributes:
        one, two: The positions of the photographs in the list.
        xy_one, xy_two: (M, 2) pixels of the stored photographs.
        motion: The median distance between the two pixels of a match, as an angle in degrees of a
            camera with a nominal focal length (of a panorama, of its own).
        found: The number of verified matches, of which ``MAX_USED`` are kept.
    """

    one: int
    two: int
    xy_one: Array
    xy_two: Array
    motion: float
    found: int


class FeatureMatcher:
    """Matches of two photographs by their features alone. Features and matches are kept, so that
    several checks of the same photographs compute them once."""

    def __init__(self) -> None:
        self._features = lru_cache(maxsize=64)(_features)
        self.match = lru_cache(maxsize=512)(self._match)

    def _match(self, one: Photo, two: Photo) -> tuple[Array, Array]:
        """(M, 2) pixels of the matches in both stored photographs."""
        (xy_one, table_one), (xy_two, table_two) = self._features(one), self._features(two)
        matches = mutual_matches(table_one, table_two, _MAX_RATIO)
        return xy_one[matches[:, 0]], xy_two[matches[:, 1]]


class PairFinder:
    """Finds pairs of photographs with matches.

    Args:
        photos: The photographs in the order of their names.
        cameras: The given cameras of the photographs, which may be wrong.
        centres: (K, N, 3) positions of the photographs according to K readings of the poses, of
            which near ones are tried if the neighbours in the order of names do not match.
        matcher: The source of matches.
    """

    def __init__(
        self,
        photos: Sequence[Photo],
        cameras: Sequence[Camera],
        centres: Array,
        matcher: FeatureMatcher,
    ) -> None:
        self._photos, self._cameras, self._centres = photos, cameras, centres
        self._matcher = matcher
        self.tried = 0

    def pairs(self) -> Iterator[MatchedPair | None]:
        """For each anchor the pair of the widest motion that was found, or None."""
        for anchor in _spread(len(self._photos)):
            with one_thread_of_opencv():
                pair = self._best(anchor)
            yield pair

    def _best(self, anchor: int) -> MatchedPair | None:
        best: MatchedPair | None = None
        for other in self._in_order(anchor):
            pair = self._match(anchor, other)
            if pair is None:
                break
            if best is None or pair.motion > best.motion:
                best = pair
            if pair.motion >= _WIDE_MOTION:
                break
        if best is None or best.motion < MIN_MOTION:
            for other in self._near(anchor):
                pair = self._match(anchor, other)
                if pair is not None and (best is None or pair.motion > best.motion):
                    best = pair
                    break
        return best if best is not None and best.motion >= MIN_MOTION else None

    def _in_order(self, anchor: int) -> list[int]:
        last = len(self._photos) - 1
        sign = 1 if anchor + 1 <= last else -1
        others = [anchor + sign * step for step in _FIRST_STEPS]
        return [other for other in others if 0 <= other <= last]

    def _near(self, anchor: int) -> list[int]:
        """The nearest photographs by each reading of the poses, not those in ``_in_order``."""
        found: list[int] = []
        for centres in self._centres:
            order = np.argsort(np.linalg.norm(centres - centres[anchor], axis=1), kind="stable")
            near = [int(i) for i in order if abs(int(i) - anchor) > 1][:2]
            found += [i for i in near if i not in found]
        return found[:3]

    def _match(self, one: int, two: int) -> MatchedPair | None:
        if one == two:
            return None
        self.tried += 1
        xy_one, xy_two = self._matcher.match(self._photos[one], self._photos[two])
        sizes = [max(self._photos[i].width, self._photos[i].height) for i in (one, two)]
        moved = np.linalg.norm(xy_one / sizes[0] - xy_two / sizes[1], axis=1) > _FIXED
        if 2 * moved.sum() > len(moved):
            xy_one, xy_two = xy_one[moved], xy_two[moved]
        directions = [
            _directions(self._photos[i], self._cameras[i], xy)
            for i, xy in ((one, xy_one), (two, xy_two))
        ]
        tolerance = _TOLERANCE_PX / (_NOMINAL * MAX_SIDE_PX)
        good = consistent_matches(directions[0], directions[1], tolerance)
        if good.sum() < max(MIN_MATCHES, MIN_SHARE * len(good)):
            return None
        if self._cameras[one].is_spherical:
            cosine = np.einsum("ni,ni->n", directions[0][good], directions[1][good])
            motion = np.arccos(np.clip(cosine, -1, 1))
        else:
            motion = np.linalg.norm(xy_one / sizes[0] - xy_two / sizes[1], axis=1)[good] / _NOMINAL
        rows = np.flatnonzero(good)
        kept = rows[np.linspace(0, len(rows) - 1, min(len(rows), MAX_USED)).astype(np.int64)]
        return MatchedPair(
            one,
            two,
            xy_one[kept],
            xy_two[kept],
            float(np.degrees(np.median(motion))),
            len(rows),
        )


def _features(photo: Photo) -> tuple[Array, NDArray[np.uint8]]:
    """(F, 2) pixels of the stored photograph and (F, 128) descriptors."""
    found = detect(DetectionImage(photo, MAX_SIDE_PX), MAX_FEATURES, CONTRAST_THRESHOLD)
    return found.xy.astype(np.float64), found.descriptors


def relative_focal(camera: Camera) -> float:
    """The camera's focal length relative to one of a nominal field of view; 1 for panoramas."""
    if camera.is_spherical:
        return 1.0
    return camera.pinhole[0] / (_NOMINAL * max(camera.width, camera.height))


def mutual_matches(
    a: NDArray[np.uint8], b: NDArray[np.uint8], max_ratio: float
) -> NDArray[np.int64]:
    """(M, 2) mutual nearest neighbours that pass Lowe's ratio test, as
    ``nearest.match_descriptors``, without the compiled library.

    Products of bytes and their sums are below 2^24 and thus exact in float32.
    """
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    x, y = a.astype(np.float32), b.astype(np.float32)
    squares = (x * x).sum(1)[:, None] + (y * y).sum(1)
    distance = squares - 2 * (x @ y.T)
    forward, backward = distance.argmin(1), distance.argmin(0)
    rows = np.arange(len(a))
    first, second = np.partition(distance, 1, axis=1)[:, :2].T
    keep = (backward[forward] == rows) & (first < max_ratio**2 * second)
    return np.column_stack([rows[keep], forward[keep]])


def _directions(photo: Photo, camera: Camera, xy: Array) -> Array:
    """(N, 3) unit directions of pixels, of a plausible camera: its given one, or one without
    distortion and of an ordinary focal length."""
    side = max(photo.width, photo.height)
    if not camera.is_spherical and not (_PLAUSIBLE[0] < camera.pinhole[0] / side < _PLAUSIBLE[1]):
        focal = _NOMINAL * side
        params = np.array([focal, photo.width / 2, photo.height / 2])
        camera = Camera("SIMPLE_PINHOLE", photo.width, photo.height, params)
    return np.nan_to_num(rays(camera, xy))


def _spread(count: int) -> list[int]:
    """``ANCHORS`` of ``count`` positions, evenly distributed, in an order whose beginnings are
    distributed too."""
    places = np.unique(np.linspace(0, count - 1, min(count, ANCHORS)).astype(np.int64))
    return [int(places[i]) for start in (0, 2, 1, 3) for i in range(start, len(places), 4)]
