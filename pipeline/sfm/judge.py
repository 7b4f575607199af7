"""Is a reconstruction to be believed?

A failed one can register every image at 0.3 px: a wrong focal length bends the scene and drops
what does not fit, so the residual of what is left says little. What was dropped says more: the
share of verified matches, between images that got a pose, that the model's points explain.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

# Bounds on the evidence. Measured on real scenes (registration by COLMAP, against true poses).
MIN_EXPLAINED_FAILED, MIN_EXPLAINED_WEAK = 0.15, 0.40
MIN_POINTS_AN_IMAGE_FAILED, MIN_POINTS_AN_IMAGE_WEAK = 10, 60
MAX_FOCAL_OFF_FAILED, MAX_FOCAL_OFF_WEAK = 2.0, 1.3
# A lens from 8 mm to 600 mm on 35 mm film: focal length over the longer side.
FOCAL_RANGE = (0.22, 17.0)
MIN_SHARE_GOOD = 0.8
MAX_REPROJECTION_WEAK_PX = 2.0
# Half of the points seen under less than this: the camera hardly moved, depths are guesses.
MIN_ANGLE_WEAK_DEG = 2.0


@dataclass(frozen=True)
class Evidence:
    """What there is to see of a model.

    Attributes:
        registered, total: images.
        points, observations_per_image, mean_track_length, reprojection_px: of the model.
        explained_matches: share of verified matches between registered images whose two keypoints
            are seen as one point.
        behind_camera: share of observations behind the camera that made them.
        median_angle_deg: of the points, the largest angle between two of their rays, the median.
        focal_off: the largest ratio of a focal length to its EXIF prior, either way up; None
            without any prior.
        focal_smallest, focal_largest: focal lengths over the image's longer side.
        focal_prior_px: camera id -> EXIF prior.
    """

    registered: int
    total: int
    points: int
    observations_per_image: float
    mean_track_length: float
    reprojection_px: float
    explained_matches: float
    behind_camera: float
    median_angle_deg: float
    focal_off: float | None
    focal_smallest: float
    focal_largest: float
    focal_prior_px: dict[int, float]


@dataclass(frozen=True)
class Verdict:
    grade: Literal["good", "weak", "failed"]
    reasons: list[str]


def judge(evidence: Evidence | None, min_registered_share: float) -> Verdict:
    """The verdict on a model, None being no model at all."""
    if evidence is None:
        return Verdict("failed", ["no photographs could be put in relation to each other"])
    e = evidence
    share, off = e.registered / e.total, e.focal_off or 1.0
    points = e.points / e.registered
    focal = f"focal length {e.focal_smallest:.2f} to {e.focal_largest:.2f} of the longer side"
    found = f"{e.registered} of {e.total} photographs got a pose"
    explained = f"only {e.explained_matches:.0%} of the verified matches fit the model"
    few = f"only {points:.0f} points for each photograph"
    prior = f"a focal length is {off:.1f} times off the one in EXIF"
    failed = [
        (share < min_registered_share, found),
        (e.explained_matches < MIN_EXPLAINED_FAILED, explained),
        (points < MIN_POINTS_AN_IMAGE_FAILED, few),
        (off > MAX_FOCAL_OFF_FAILED, prior),
        (e.focal_smallest < FOCAL_RANGE[0] or e.focal_largest > FOCAL_RANGE[1], focal),
        (e.behind_camera > 0.01, f"{e.behind_camera:.0%} of the points are behind their cameras"),
    ]
    weak = [
        (share < MIN_SHARE_GOOD, found),
        (e.explained_matches < MIN_EXPLAINED_WEAK, explained),
        (points < MIN_POINTS_AN_IMAGE_WEAK, few),
        (off > MAX_FOCAL_OFF_WEAK, prior),
        (
            e.reprojection_px > MAX_REPROJECTION_WEAK_PX,
            f"the points miss their keypoints by {e.reprojection_px:.1f} px",
        ),
        (
            e.median_angle_deg < MIN_ANGLE_WEAK_DEG,
            f"the camera hardly moved: half of the points are seen within "
            f"{e.median_angle_deg:.1f} degrees",
        ),
    ]
    for grade, tests in (("failed", failed), ("weak", weak)):
        reasons = [text for hit, text in tests if hit]
        if reasons:
            return Verdict(grade, reasons)  # type: ignore[arg-type]
    return Verdict("good", [])


def gather(model: pycolmap.Reconstruction, database: Path, total: int) -> Evidence:
    """The evidence on ``model``, which was made from ``database``."""
    registered = sorted(model.reg_image_ids())
    behind, observations, angles = _geometry(model)
    used = {model.image(i).camera_id for i in registered}
    priors = {}
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            if camera.has_prior_focal_length and camera.camera_id in used:
                priors[camera.camera_id] = float(camera.mean_focal_length())
        explained = _explained_matches(model, opened)
    focal = {i: float(model.camera(i).mean_focal_length()) for i in used}
    relative = [f / max(model.camera(i).width, model.camera(i).height) for i, f in focal.items()]
    off = [max(focal[i] / prior, prior / max(focal[i], 1e-9)) for i, prior in priors.items()]
    return Evidence(
        registered=len(registered),
        total=total,
        points=int(model.num_points3D()),
        observations_per_image=observations / max(len(registered), 1),
        mean_track_length=float(model.compute_mean_track_length()),
        reprojection_px=float(model.compute_mean_reprojection_error()),
        explained_matches=explained,
        behind_camera=behind,
        median_angle_deg=float(np.median(angles)) if len(angles) else 0.0,
        focal_off=max(off) if off else None,
        focal_smallest=min(relative),
        focal_largest=max(relative),
        focal_prior_px=priors,
    )


def _geometry(model: pycolmap.Reconstruction) -> tuple[float, int, NDArray[np.float64]]:
    """Share of observations behind their camera, their number, and each point's angle (degrees)
    between the rays of its first camera and of the one farthest from that."""
    poses = {}
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        poses[image_id] = (image.cam_from_world().matrix()[2], image.projection_center())
    behind, observations = 0, 0
    angles = np.zeros(model.num_points3D())
    for place, point in enumerate(model.points3D.values()):
        seen = [poses[element.image_id] for element in point.track.elements]
        axes, centres = (np.array(column) for column in zip(*seen, strict=True))
        behind += int((axes[:, :3] @ point.xyz + axes[:, 3] <= 0).sum())
        observations += len(seen)
        rays = centres - point.xyz
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles[place] = np.degrees(np.arccos(np.clip((rays @ rays[0]).min(), -1, 1)))
    return behind / max(observations, 1), observations, angles


def _explained_matches(model: pycolmap.Reconstruction, database: pycolmap.Database) -> float:
    """Share of verified matches between registered images that join keypoints of one point."""
    seen: dict[int, NDArray[np.int64]] = {}
    for image_id in model.reg_image_ids():
        points = np.full(database.num_keypoints_for_image(image_id), -1, np.int64)
        for index, point2D in enumerate(model.image(image_id).points2D):
            if point2D.has_point3D():
                points[index] = point2D.point3D_id
        seen[image_id] = points
    explained, matches = 0, 0
    ids, geometries = database.read_two_view_geometries()
    for pair_id, geometry in zip(ids, geometries, strict=True):
        first, second = pycolmap.pair_id_to_image_pair(pair_id)
        inliers = geometry.inlier_matches
        if first not in seen or second not in seen or len(inliers) == 0:
            continue
        a, b = seen[first][inliers[:, 0]], seen[second][inliers[:, 1]]
        explained += int(((a == b) & (a >= 0)).sum())
        matches += len(inliers)
    return explained / max(matches, 1)
