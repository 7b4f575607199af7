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

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.sfm.bearings import (
    camera_pixels,
    camera_rays,
    image_side,
    is_wide,
    pixels_per_radian,
)
from pipeline.sfm.pairs import proximity_pairs

Floats = NDArray[np.float64]
Pairs = dict[tuple[int, int], NDArray[np.uint32]]

# Largest Sampson distance of an agreeing match, as a share of the image's longer side (pycolmap
# verifies matches within 4 px).
MAX_SAMPSON_DISTANCE = 0.006
# A pair agrees with the model if at least this share of its matches agree.
MIN_AGREEING_SHARE = 0.5
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


@dataclass(frozen=True)
class Consistency:
    """Two-view consistency of a model.

    Attributes:
        agreeing_matches: share of the verified matches between registered images that satisfy the
            epipolar constraint of the model's relative pose and triangulate in front of both
            cameras.
        agreeing_pairs: share of the strong pairs of which at least half of the matches agree.
        missing_covisibility: share of neighbouring images that should observe many common points
            and observe few.
    """

    agreeing_matches: float
    agreeing_pairs: float
    missing_covisibility: float


@dataclass(frozen=True)
class _View:
    """One registered image.

    Attributes:
        rotation, translation: world to camera, (3, 3) and (3,).
        normalized: (F, 2) keypoints in normalized image coordinates (on the plane z = 1).
        rays: (F, 3) unit rays of the keypoints of a wide camera, else None.
        points: sorted ids of the observed 3D points.
        side: longer side, pixels; of a panorama see ``image_side``.
        focal: focal length, or pixels per radian at the centre of a panorama.
    """

    rotation: Floats
    translation: Floats
    normalized: Floats
    rays: Floats | None
    points: NDArray[np.int64]
    side: float
    focal: float


def measure_consistency(
    model: pycolmap.Reconstruction, database: pycolmap.Database, pairs: Pairs
) -> Consistency:
    """Compute the two-view consistency of ``model``.

    Args:
        database: the database with the keypoints of the model's images.
        pairs: image ids -> (M, 2) verified matches, for pairs of registered images.
    """
    views = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        camera = model.camera(image.camera_id)
        pose = image.cam_from_world()
        xy = database.read_keypoints(image_id)[:, :2].astype(np.float64)
        seen = [p.point3D_id for p in image.points2D if p.has_point3D()]
        views[image_id] = _View(
            rotation=pose.rotation.matrix(),
            translation=np.asarray(pose.translation),
            normalized=np.asarray(camera.cam_from_img(xy), np.float64).reshape(-1, 2),
            rays=camera_rays(camera, xy) if is_wide(camera) else None,
            points=np.unique(np.array(seen, np.int64)),
            side=image_side(camera),
            focal=pixels_per_radian(camera),
        )
    agreeing, matches = 0, 0
    strongest: dict[int, int] = {}
    for pair, inliers in pairs.items():
        for image_id in pair:
            strongest[image_id] = max(strongest.get(image_id, 0), len(inliers))
    strong_pairs_agree = []
    for (first, second), inliers in pairs.items():
        agree = _matches_agree(views[first], views[second], inliers)
        agreeing += int(agree.sum())
        matches += len(agree)
        if len(agree) >= STRONG_SHARE * min(strongest[first], strongest[second]):
            strong_pairs_agree.append(bool(agree.mean() >= MIN_AGREEING_SHARE))
    return Consistency(
        agreeing_matches=agreeing / max(matches, 1),
        agreeing_pairs=sum(strong_pairs_agree) / max(len(strong_pairs_agree), 1),
        missing_covisibility=_missing_covisibility(model, views),
    )


def _matches_agree(a: _View, b: _View, matches: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """(M,) True for matches that satisfy the essential matrix of the pair's relative pose (by the
    Sampson distance) and triangulate in front of both cameras."""
    rotation = b.rotation @ a.rotation.T
    translation = b.translation - rotation @ a.translation
    translation = translation / max(float(np.linalg.norm(translation)), 1e-12)
    wide = a.rays is not None or b.rays is not None
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


def _directions(view: _View, chosen: NDArray[np.uint32], wide: bool) -> Floats:
    """(M, 3) rays through keypoints: of depth 1, or unit vectors if one of the cameras is wide."""
    if view.rays is not None:
        return view.rays[chosen]
    flat = np.column_stack([view.normalized[chosen], np.ones(len(chosen))])
    return flat / np.linalg.norm(flat, axis=1, keepdims=True) if wide else flat


def _missing_covisibility(model: pycolmap.Reconstruction, views: dict[int, _View]) -> float:
    """Share of neighbouring images whose expected common points are mostly not observed.

    Shares of observed points are compared among pairs of the same kinds of images: a panorama
    observes few of the points of a photograph, which has several times its angular resolution.
    """
    ids = list(views)
    if len(ids) < 2:
        return 0.0
    centres = np.stack([-views[i].rotation.T @ views[i].translation for i in ids])
    axes = _axes(model, ids, views)
    point_ids = np.array(sorted(model.points3D), np.int64)
    xyz = np.stack([model.point3D(int(i)).xyz for i in point_ids])
    spheres = _spheres(model, ids)
    shares: dict[tuple[bool, bool], list[float]] = {}
    for pair in proximity_pairs(centres, axes, NEIGHBOURS):
        for one, other in (pair, pair[::-1]):
            own = views[ids[one]].points
            expected = _expected_visible(
                model,
                ids[other],
                views[ids[other]],
                centres[one],
                centres[other],
                xyz[np.searchsorted(point_ids, own)],
            )
            if expected.sum() >= MIN_EXPECTED_POINTS:
                common = np.isin(own[expected], views[ids[other]].points, assume_unique=True)
                kinds = (bool(spheres[one]), bool(spheres[other]))
                shares.setdefault(kinds, []).append(float(common.mean()))
    missing = [
        share < COVISIBLE_SHARE * np.percentile(of_kinds, 75)
        for of_kinds in shares.values()
        for share in of_kinds
    ]
    return float(np.mean(missing)) if missing else 0.0


def _spheres(model: pycolmap.Reconstruction, ids: list[int]) -> NDArray[np.bool_]:
    """(N,) whether the images are panoramas."""
    return np.array([model.camera(model.image(i).camera_id).is_spherical() for i in ids])


def _axes(model: pycolmap.Reconstruction, ids: list[int], views: dict[int, _View]) -> Floats:
    """(N, 3) viewing directions. Panoramas look everywhere: all have the same direction, the mean
    of the others."""
    axes = np.stack([views[i].rotation[2] for i in ids])
    spheres = _spheres(model, ids)
    if spheres.any():
        mean = axes[~spheres].sum(axis=0) if not spheres.all() else np.array([0.0, 0.0, 1.0])
        axes[spheres] = mean / max(float(np.linalg.norm(mean)), 1e-12)
    return axes


def _expected_visible(
    model: pycolmap.Reconstruction,
    image_id: int,
    view: _View,
    from_centre: Floats,
    to_centre: Floats,
    xyz: Floats,
) -> NDArray[np.bool_]:
    """(P,) True for points that should be visible in an image.

    Args:
        image_id, view: the image.
        from_centre: centre of the camera that observes the points.
        to_centre: centre of the image's camera.
        xyz: (P, 3) points. A point should be visible if it projects into the image and both cameras
            observe it from a similar direction and distance.
    """
    camera = model.camera(model.image(image_id).camera_id)
    local = xyz @ view.rotation.T + view.translation
    in_front = local[:, 2] > 1e-9
    xy = np.full((len(xyz), 2), np.nan)
    if is_wide(camera):
        xy = camera_pixels(camera, local)
    elif in_front.any():
        xy[in_front] = np.asarray(camera.img_from_cam(local[in_front]), np.float64).reshape(-1, 2)
    border = BORDER * max(camera.width, camera.height)
    inside = ((xy > border) & (xy < (camera.width - border, camera.height - border))).all(1)
    ray_one, ray_other = xyz - from_centre, xyz - to_centre
    length_one, length_other = (np.linalg.norm(r, axis=1) for r in (ray_one, ray_other))
    cosine = (ray_one * ray_other).sum(1) / np.maximum(length_one * length_other, 1e-24)
    ratio = length_one / np.maximum(length_other, 1e-24)
    return np.asarray(
        inside
        & (cosine > np.cos(np.radians(NEAR_ANGLE_DEG)))
        & (np.abs(np.log(np.maximum(ratio, 1e-12))) < np.log(NEAR_RATIO))
    )
