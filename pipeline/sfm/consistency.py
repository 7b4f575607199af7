"""Does a model agree with what pairs of photographs say by themselves?

Two questions that a bent or folded model answers badly, however small its residuals are:

- Do the verified matches of each pair obey the epipolar geometry that the model gives the pair?
  The pairs were verified without the model, each for itself.
- Are points that one photograph sees seen again by its neighbours? Where two sides of a building
  look alike, a model puts both onto one place: neighbours there share the look-alike part, and
  each sees surroundings of its own that the other should see and does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.sfm.pairs import proximity_pairs

Floats = NDArray[np.float64]
Pairs = dict[tuple[int, int], NDArray[np.uint32]]

# A match agrees within this share of the picture's longer side (pycolmap verifies within 4 px).
AGREEMENT = 0.006
# A pair of which fewer matches agree contradicts the model.
PAIR_SHARE = 0.5
# Asked are the pairs with this share, at least, of the matches of the strongest pair of one of
# their photographs: parts that look alike verify weaker ones, which right models contradict.
STRONG_SHARE = 0.3

# Neighbours for the second question: of each photograph as many, whose rays to a point are within
# that angle, at distances within that ratio, and which should share as many points at least.
NEIGHBOURS = 8
NEAR_ANGLE_DEG = 12.0
NEAR_RATIO = 1.4
NEAR_POINTS = 40
# Points nearer to the border than this share of the longer side may be cut off.
BORDER = 0.03
# Neighbours that see less than this share of what the best quarter of neighbours see again.
STRANGER_SHARE = 0.3


@dataclass(frozen=True)
class Consistency:
    """Attributes:
    agreeing_matches: share of the verified matches between registered images that lie on the
        epipolar lines which the model gives their pair, in front of both cameras.
    agreeing_pairs: share of the strong pairs most of whose matches do.
    strangers: share of neighbouring views that hardly see one another's points again.
    """

    agreeing_matches: float
    agreeing_pairs: float
    strangers: float


@dataclass(frozen=True)
class _Posed:
    """One registered image: world to camera, keypoints' rays (z = 1), the points they see."""

    rotation: Floats
    translation: Floats
    plane: Floats
    points: NDArray[np.int64]
    """Sorted ids."""
    side: int
    focal: float


def check(model: pycolmap.Reconstruction, database: pycolmap.Database, pairs: Pairs) -> Consistency:
    """Ask both questions.

    Args:
        pairs: image ids -> (M, 2) verified matches, of pairs of registered images.
    """
    posed = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        camera = model.camera(image.camera_id)
        pose = image.cam_from_world()
        xy = database.read_keypoints(image_id)[:, :2].astype(np.float64)
        seen = [p.point3D_id for p in image.points2D if p.has_point3D()]
        posed[image_id] = _Posed(
            rotation=pose.rotation.matrix(),
            translation=np.asarray(pose.translation),
            plane=np.asarray(camera.cam_from_img(xy), np.float64).reshape(-1, 2),
            points=np.unique(np.array(seen, np.int64)),
            side=max(camera.width, camera.height),
            focal=float(camera.mean_focal_length()),
        )
    agreeing, matches = 0, 0
    strongest: dict[int, int] = {}
    for pair, inliers in pairs.items():
        for image_id in pair:
            strongest[image_id] = max(strongest.get(image_id, 0), len(inliers))
    asked = []
    for (first, second), inliers in pairs.items():
        agree = _agree(posed[first], posed[second], inliers)
        agreeing += int(agree.sum())
        matches += len(agree)
        if len(agree) >= STRONG_SHARE * min(strongest[first], strongest[second]):
            asked.append(bool(agree.mean() >= PAIR_SHARE))
    return Consistency(
        agreeing_matches=agreeing / max(matches, 1),
        agreeing_pairs=sum(asked) / max(len(asked), 1),
        strangers=_strangers(model, posed),
    )


def _agree(a: _Posed, b: _Posed, matches: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """(M,) which matches obey the pair's essential matrix (Sampson's distance) and are not behind
    a camera."""
    rotation = b.rotation @ a.rotation.T
    translation = b.translation - rotation @ a.translation
    translation = translation / max(float(np.linalg.norm(translation)), 1e-12)
    x = np.column_stack([a.plane[matches[:, 0]], np.ones(len(matches))])
    y = np.column_stack([b.plane[matches[:, 1]], np.ones(len(matches))])
    turned = x @ rotation.T
    line_b = np.cross(translation, turned)  # E x
    line_a = np.cross(y, translation) @ rotation  # E^T y
    error = (y * line_b).sum(1)
    norm = (line_a[:, :2] ** 2).sum(1) + (line_b[:, :2] ** 2).sum(1)
    sampson = np.abs(error) / np.sqrt(np.maximum(norm, 1e-24))
    near = sampson * (a.focal + b.focal) / 2 <= AGREEMENT * max(a.side, b.side)
    # Depths of the two rays' nearest points, up to a positive factor: y d2 = R x d1 + t.
    depth_a = (np.cross(y, turned) * -np.cross(y, translation)).sum(1)
    depth_b = (np.cross(turned, y) * np.cross(turned, translation)).sum(1)
    # Rays that are parallel but for noise meet anywhere.
    size = np.linalg.norm(turned, axis=1) * np.linalg.norm(y, axis=1)
    parallel = np.linalg.norm(np.cross(y, turned), axis=1) < size * np.radians(0.5)
    return np.asarray(near & (parallel | ((depth_a > 0) & (depth_b > 0))))


def _strangers(model: pycolmap.Reconstruction, posed: dict[int, _Posed]) -> float:
    ids = list(posed)
    if len(ids) < 2:
        return 0.0
    centres = np.stack([-posed[i].rotation.T @ posed[i].translation for i in ids])
    axes = np.stack([posed[i].rotation[2] for i in ids])
    point_ids = np.array(sorted(model.points3D), np.int64)
    xyz = np.stack([model.point3D(int(i)).xyz for i in point_ids])
    shares = []
    for near in proximity_pairs(centres, axes, NEIGHBOURS):
        for one, other in (near, near[::-1]):
            own = posed[ids[one]].points
            expected = _expected(
                model,
                ids[other],
                posed[ids[other]],
                centres[one],
                centres[other],
                xyz[np.searchsorted(point_ids, own)],
            )
            if expected.sum() >= NEAR_POINTS:
                again = np.isin(own[expected], posed[ids[other]].points, assume_unique=True)
                shares.append(float(again.mean()))
    if not shares:
        return 0.0
    usual = float(np.percentile(shares, 75))
    return float(np.mean(np.array(shares) < STRANGER_SHARE * usual))


def _expected(
    model: pycolmap.Reconstruction,
    image_id: int,
    to: _Posed,
    from_centre: Floats,
    to_centre: Floats,
    xyz: Floats,
) -> NDArray[np.bool_]:
    """(P,) which points seen from one centre the image should see: in the picture, from nearly
    the same side, at nearly the same distance."""
    camera = model.camera(model.image(image_id).camera_id)
    local = xyz @ to.rotation.T + to.translation
    ahead = local[:, 2] > 1e-9
    xy = np.full((len(xyz), 2), np.nan)
    if ahead.any():
        xy[ahead] = np.asarray(camera.img_from_cam(local[ahead]), np.float64).reshape(-1, 2)
    border = BORDER * to.side
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
