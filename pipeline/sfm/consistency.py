"""Two-view consistency of a reconstruction.

Two statistics that expose a bent or folded model even if its reprojection errors are small:

- Epipolar agreement: the share of verified matches that satisfy the epipolar geometry implied by
  the model's poses. Two-view geometry was verified for each pair independently of the model.
- Covisibility: the share of neighbouring images that do not observe the same 3D points. Repeated
  structure (doppelgangers) makes a mapper register two places on top of each other. Images
  registered side by side there share the repeated part only; each observes surroundings that should
  be visible in the other and are not.
"""

from __future__ import annotations

from collections.abc import Set
from typing import NamedTuple

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.sfm.model_views import Floats, ModelView, Pairs
from pipeline.sfm.pairs import proximity_pairs

# Largest Sampson distance of an agreeing match, as a share of the image's longer side (pycolmap
# verifies matches within 4 px).
MAX_SAMPSON_DISTANCE = 0.006
# A pair agrees with the model if at least this share of its matches agree.
MIN_AGREEING_SHARE = 0.5
# A distinctive pair contradicts the model below this share: folded models show at most 0.25, and
# the few noisy matches of blurred photographs may agree by half.
MIN_DISTINCTIVE_SHARE = 0.35
# A pair is strong if it has at least this share of the matches of the strongest pair of one of its
# images. Weaker pairs are ignored: repeated structure verifies them falsely, and they contradict
# correct models.
STRONG_SHARE = 0.3

# Neighbours considered for covisibility of each image. A point should be visible in a neighbour if
# the viewing angle differs by at most NEAR_ANGLE_DEG and the distance by at most a factor of
# NEAR_RATIO. Neighbours that should share fewer than MIN_EXPECTED_POINTS are not considered.
NEIGHBOURS = 8
NEAR_ANGLE_DEG = 12.0
NEAR_RATIO = 1.4
MIN_EXPECTED_POINTS = 40
# Margin inside the image border, as a share of the longer side: keypoints are missing there.
BORDER = 0.03
# Two neighbours lack covisibility if they share less than this fraction of the upper quartile of
# neighbours of their kinds.
COVISIBLE_SHARE = 0.3


class Consistency(NamedTuple):
    """Two-view consistency of a model; see the fields of ``Evidence`` with these names."""

    agreeing_matches: float
    agreeing_pairs: float
    agreeing_distinctive: float
    missing_covisibility: float


def measure_consistency(
    model: pycolmap.Reconstruction,
    views: dict[int, ModelView],
    pairs: Pairs,
    distinctive: set[tuple[int, int]],
) -> Consistency:
    """Compute the two-view consistency of ``model``.

    Args:
        views: The registered images.
        pairs: Verified matches of pairs of registered images.
        distinctive: The result of ``distinctive_pairs``, of all images.
    """
    agreeing, matches, strong_pairs_agree, distinctive_agree = 0, 0, [], []
    strongest: dict[int, int] = {}
    for pair, inliers in pairs.items():
        for image_id in pair:
            strongest[image_id] = max(strongest.get(image_id, 0), len(inliers))
    for (first, second), inliers in pairs.items():
        agree = matches_agree(views[first], views[second], inliers)
        agreeing += int(agree.sum())
        matches += len(agree)
        if (first, second) in distinctive:
            distinctive_agree.append(bool(agree.mean() >= MIN_DISTINCTIVE_SHARE))
        if len(agree) >= STRONG_SHARE * min(strongest[first], strongest[second]):
            strong_pairs_agree.append(bool(agree.mean() >= MIN_AGREEING_SHARE))
    return Consistency(
        agreeing_matches=agreeing / max(matches, 1),
        agreeing_pairs=sum(strong_pairs_agree) / max(len(strong_pairs_agree), 1),
        agreeing_distinctive=float(np.mean(distinctive_agree)) if distinctive_agree else 1.0,
        missing_covisibility=missing_covisibility(model, views),
    )


def pair_agrees(a: ModelView, b: ModelView, matches: NDArray[np.uint32]) -> bool:
    """Whether at least half of the (M, 2) verified matches of two images agree with their poses."""
    return bool(matches_agree(a, b, matches).mean() >= MIN_AGREEING_SHARE)


def matches_agree(a: ModelView, b: ModelView, matches: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """(M,) True for matches that satisfy the essential matrix of the pair's relative pose (by the
    Sampson distance) and triangulate in front of both cameras."""
    rotation = b.rotation @ a.rotation.T
    translation = b.translation - rotation @ a.translation
    translation = translation / max(float(np.linalg.norm(translation)), 1e-12)
    wide = a.is_wide or b.is_wide
    x, y = (_directions(v, m, wide) for v, m in ((a, matches[:, 0]), (b, matches[:, 1])))
    rotated = x @ rotation.T
    line_b = np.cross(translation, rotated)  # E x
    line_a = np.cross(y, translation) @ rotation  # E^T y
    error = (y * line_b).sum(1)
    if wide:
        # Rays vary on the sphere: the derivative is the part of the line perpendicular to the ray.
        along_a, along_b = (line_a * x).sum(1), (line_b * y).sum(1)
        norm = (line_a**2).sum(1) - along_a**2 + (line_b**2).sum(1) - along_b**2
    else:
        norm = (line_a[:, :2] ** 2).sum(1) + (line_b[:, :2] ** 2).sum(1)
    sampson = np.abs(error) / np.sqrt(np.maximum(norm, 1e-24))
    on_line = sampson * (a.focal + b.focal) / 2 <= MAX_SAMPSON_DISTANCE * max(a.side, b.side)
    # Depths of the triangulated point, up to a positive factor: y d2 = R x d1 + t.
    depth_a = (np.cross(y, rotated) * -np.cross(y, translation)).sum(1)
    depth_b = (np.cross(rotated, y) * np.cross(rotated, translation)).sum(1)
    # The sign of the depth is not reliable for nearly parallel rays.
    size = np.linalg.norm(rotated, axis=1) * np.linalg.norm(y, axis=1)
    parallel = np.linalg.norm(np.cross(y, rotated), axis=1) < size * np.radians(0.5)
    return np.asarray(on_line & (parallel | ((depth_a > 0) & (depth_b > 0))))


def _directions(view: ModelView, chosen: NDArray[np.uint32], wide: bool) -> Floats:
    """(M, 3) rays through keypoints: of depth 1, or unit vectors if one of the cameras is wide."""
    if view.is_wide:
        return view.rays[chosen]
    flat = view.plane[chosen]
    return flat / np.linalg.norm(flat, axis=1, keepdims=True) if wide else flat


def missing_covisibility(
    model: pycolmap.Reconstruction,
    by_id: dict[int, ModelView],
    across: Set[int] = frozenset(),
) -> float:
    """Share of neighbouring images whose expected common points are mostly not observed.

    Shares of observed points are compared among pairs of the same kinds of images: a panorama
    observes few of the points of a photograph, which has several times its angular resolution.

    Args:
        by_id: The registered images by their ids.
        across: Only pairs of an image in this set with another one are counted, if it has any.
    """
    views, counted = list(by_id.values()), [image_id in across for image_id in by_id]
    if len(views) < 2:
        return 0.0
    centres = np.stack([view.centre for view in views])
    point_ids = np.array(sorted(model.points3D), np.int64)
    xyz = np.stack([model.point3D(int(i)).xyz for i in point_ids])
    shares: dict[tuple[bool, bool], list[tuple[float, bool]]] = {}
    for i, j in proximity_pairs(centres, _axes(views), NEIGHBOURS):
        for one, other in ((views[i], views[j]), (views[j], views[i])):
            observed = xyz[np.searchsorted(point_ids, one.points)]
            expected = _expected_visible(one, other, observed)
            if expected.sum() >= MIN_EXPECTED_POINTS:
                common = np.isin(one.points[expected], other.points, assume_unique=True)
                kinds = one.is_panorama, other.is_panorama
                shares.setdefault(kinds, []).append(
                    (float(common.mean()), not across or counted[i] != counted[j])
                )
    missing = [
        share < COVISIBLE_SHARE * np.percentile([share for share, _ in of_kinds], 75)
        for of_kinds in shares.values()
        for share, is_counted in of_kinds
        if is_counted
    ]
    return float(np.mean(missing)) if missing else 0.0


def _axes(views: list[ModelView]) -> Floats:
    """(N, 3) viewing directions. Panoramas look everywhere: all have the same direction, the mean
    of the others."""
    axes = np.stack([view.rotation[2] for view in views])
    spheres = np.array([view.is_panorama for view in views])
    if spheres.any():
        mean = axes[~spheres].sum(axis=0) if not spheres.all() else np.array([0.0, 0.0, 1.0])
        axes[spheres] = mean / max(float(np.linalg.norm(mean)), 1e-12)
    return axes


def _expected_visible(one: ModelView, other: ModelView, xyz: Floats) -> NDArray[np.bool_]:
    """(P,) True for points that ``one`` observes and that should be visible in ``other``.

    A point should be visible if it projects into the image and both cameras observe it from a
    similar direction and distance.

    Args:
        xyz: (P, 3) points.
    """
    xy, camera = other.projected(xyz), other.camera
    border = BORDER * other.longer_side
    inside = ((xy > border) & (xy < (camera.width - border, camera.height - border))).all(1)
    ray_one, ray_other = xyz - one.centre, xyz - other.centre
    length_one, length_other = (np.linalg.norm(r, axis=1) for r in (ray_one, ray_other))
    cosine = (ray_one * ray_other).sum(1) / np.maximum(length_one * length_other, 1e-24)
    ratio = length_one / np.maximum(length_other, 1e-24)
    return np.asarray(
        inside
        & (cosine > np.cos(np.radians(NEAR_ANGLE_DEG)))
        & (np.abs(np.log(np.maximum(ratio, 1e-12))) < np.log(NEAR_RATIO))
    )
