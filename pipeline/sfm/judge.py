"""Is a reconstruction to be believed?

A failed one can register every image at 0.3 px: a wrong focal length bends the scene and drops
what does not fit, so the residual of what is left says little. What was dropped says more: the
share of verified matches, between images that got a pose, that the model's points explain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

# Bounds on the evidence. Measured on real scenes (registration by COLMAP, against true poses).
MIN_EXPLAINED_FAILED, MIN_EXPLAINED_WEAK = 0.15, 0.40
MIN_POINTS_AN_IMAGE_FAILED, MIN_POINTS_AN_IMAGE_WEAK = 10, 60
MAX_FOCAL_OFF_FAILED, MAX_FOCAL_OFF_WEAK = 2.0, 1.3
# A lens from 8 mm to 600 mm on 35 mm film: focal length over the longer side.
FOCAL_RANGE = (0.22, 17.0)
MIN_SHARE_GOOD = 0.8
MAX_REPROJECTION_WEAK_PX = 2.0
# Matches that a camera which only turns would see as well, but for noise (half a pixel).
MIN_PARALLAX_FAILED, MIN_PARALLAX_WEAK = 0.0015, 0.004
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
        parallax: how far matches are from what a camera that only turns would see, over the
            longer side.
        median_angle_deg: of the points, the largest angle between two of their rays, the median.
        focal_off: ratio of the focal length to its EXIF prior, either way up, of the median image
            with a prior; None without any (pictures cropped after they were taken have wrong ones).
        focal_relative: focal length over the longer side, of the median image.
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
    parallax: float
    median_angle_deg: float
    focal_off: float | None
    focal_relative: float
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
    focal = f"the focal length is {e.focal_relative:.2f} times the picture's longer side"
    found = f"{e.registered} of {e.total} photographs got a pose"
    explained = f"only {e.explained_matches:.0%} of the verified matches fit the model"
    few = f"only {points:.0f} points for each photograph"
    prior = f"the focal length is {off:.1f} times off the one in EXIF"
    turned = "the camera only turned, or hardly moved: nothing shows how far away things are"
    failed = [
        (share < min_registered_share, found),
        (e.explained_matches < MIN_EXPLAINED_FAILED, explained),
        (points < MIN_POINTS_AN_IMAGE_FAILED, few),
        (off > MAX_FOCAL_OFF_FAILED, prior),
        (not FOCAL_RANGE[0] <= e.focal_relative <= FOCAL_RANGE[1], focal),
        (e.parallax < MIN_PARALLAX_FAILED, turned),
        (e.behind_camera > 0.01, f"{e.behind_camera:.0%} of the points are behind their cameras"),
    ]
    weak = [
        (e.parallax < MIN_PARALLAX_WEAK, turned),
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
