"""Quality check of a reconstruction: "good", "weak" or "failed", with reasons and remedies.

The reprojection error is not sufficient: a failed model can register every image at 0.3 px. A wrong
focal length bends the scene and the mapper drops the observations that do not fit; repeated
structure (doppelgangers) folds the model onto itself. The check therefore considers the matches
that the model does not explain, two-view consistency, covisibility of neighbouring images, and
whether the images determine the focal length at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

Grade = Literal["good", "weak", "failed"]

# Thresholds (failed, weak), chosen on the corpus of ``python -m benchmarks.judge``: each lies
# between the values of correct and of wrong models, closer to the wrong ones.
MIN_EXPLAINED = (0.20, 0.40)
MIN_OBSERVATIONS = (15, 60)
MIN_AGREEING_PAIRS = (0.93, 0.98)
# The second fails a model without look-alikes too: it was mapped from pairs that it contradicts.
MIN_AGREEING_DISTINCTIVE = (0.96, 0.98)
MAX_MISSING_COVISIBILITY = (0.35, 0.15)
# The threshold of weak models if the strong and the distinctive pairs all agree: photographs far
# apart around a thing observe few common points.
ALL_AGREE, MAX_MISSING_COVISIBILITY_ALL_AGREE = 0.995, 0.3
# The same if pairs were left out, because those that are left agree by their choice.
MAX_MISSING_COVISIBILITY_LEFT_OUT = 0.22
# A model that exceeds both is folded, although each alone would only be weak.
FOLDED_AGREEING, FOLDED_MISSING_COVISIBILITY = 0.97, 0.15
# Below this, pure rotation explains the matches up to noise (half a pixel).
MIN_PARALLAX = (0.0018, 0.004)
# With a parallax below the first, a model whose parallax over its median angle in radians is below
# the second took noise of the matches for depth.
SMALL_PARALLAX, MIN_PARALLAX_PER_ANGLE = 0.006, 0.08
MAX_BEHIND = 0.01
# Focal length over the longer side: lenses from 8 mm to 600 mm on 35 mm film.
FOCAL_RANGE = (0.22, 17.0)
# EXIF focal lengths are rounded by a few per cent. A larger ratio means a cropped image or a wrong
# model.
MAX_FOCAL_OFF = 1.3
# If the cost rises by a smaller share for another focal length, the images do not determine which
# one is correct (planar scenes, forward motion).
MIN_FOCAL_CERTAINTY = 0.1
# The factor by which focal lengths are changed for ``focal_certainty``, and the number of images.
FOCAL_STEP, FOCAL_IMAGES = 1.2, 30
# Largest standard deviation of a focal length without EXIF, relative to it. The residuals of an
# image count as at most so many independent ones: errors of the camera model are common to them.
MAX_FOCAL_DEVIATION, MAX_RESIDUALS_PER_IMAGE = 0.05, 250
# The distortion of a model whose focal length is wrong may make up for it. Tele lenses have 1.05.
MAX_PINCUSHION = 1.3
MIN_SHARE_GOOD = 0.8
MAX_REPROJECTION_WEAK_PX = 2.0
# Median triangulation angle below which the baseline is too short for reliable depths.
MIN_ANGLE_WEAK_DEG = 2.0
# If at least this share of the largest connected component is registered, another mapping attempt
# cannot register many more images.
REGISTERED_SHARE_OF_COMPONENT = 0.9

_MORE = "take more photographs around the subject, each overlapping the previous one by two thirds"
_OPTIONS = "raise features.max_features and matches.neighbours, or set matches.pairs: exhaustive"
_MOVE = "move sideways around the subject between photographs instead of turning on the spot"
_TEXTURE = "photograph textured surfaces, in focus and in constant light"
_FOCAL = (
    "keep the original files with their EXIF data, use one lens at a fixed zoom, and add "
    "photographs from higher, lower and closer viewpoints that show depth"
)
_REPEATED = (
    "add photographs that show the parts that look alike together with their surroundings, and "
    "take more photographs when you go around corners"
)


class Evidence(BaseModel):
    """Statistics of a model from which ``judge`` derives its verdict."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    registered: int = Field(description="Number of registered images.")
    total: int = Field(description="Number of all images.")
    reachable: int = Field(
        description="Number of images in the largest connected component of the view graph."
    )
    points: int = Field(description="Number of points.")
    observations_per_image: float = Field(description="Mean number of observations per image.")
    mean_track_length: float = Field(description="Mean number of observations per point.")
    reprojection_px: float = Field(description="Mean reprojection error, pixels.")
    explained_matches: float = Field(
        description="Share of the verified matches between registered images whose two keypoints "
        "are observations of the same point."
    )
    agreeing_matches: float = Field(
        description="Share of the verified matches between registered images that satisfy the "
        "epipolar constraint of the model's relative pose and triangulate in front of both cameras."
    )
    agreeing_pairs: float = Field(
        description="Share of the strong pairs of which at least half of the matches agree."
    )
    agreeing_distinctive: float = Field(
        description="Share of the distinctive pairs of which at least 35 % of the matches agree. "
        "Distinctive pairs share what few other images show, hence they are no look-alikes."
    )
    pairs_left_out: bool = Field(
        description="Whether the model was mapped without the pairs that contradict trusted ones. "
        "Then ``agreeing_pairs`` is of the pairs that were kept, and says less."
    )
    broken_steps: int = Field(
        description="Number of steps between neighbours of a sequence at which the model turns the "
        "camera far more than the sequence does, and most verified pairs across it contradict that."
    )
    missing_covisibility: float = Field(
        description="Share of neighbouring images that should observe many common points and "
        "observe few."
    )
    behind_camera: float = Field(
        description="Share of the observations whose point is behind the camera."
    )
    parallax: float = Field(
        description="Residual of the matches under pure rotation, as a share of the longer side."
    )
    median_angle_deg: float = Field(
        description="Median over the points of the triangulation angle, degrees."
    )
    focal_off: float | None = Field(
        description="Median over the images with an EXIF focal length of the factor by which it "
        "differs from the model's, at least 1; null without EXIF focal lengths. Images cropped "
        "after capture have wrong ones."
    )
    focal_certainty: float | None = Field(
        description="Smallest relative increase of the bundle adjustment cost for a focal length "
        "that is off by 20 %; null (not computed) if the focal length agrees with EXIF and the "
        "photographs do not show a plane."
    )
    pincushion: float = Field(
        description="Largest factor over the cameras by which the distortion moves the middle of "
        "the shorter edge outwards; 1 without distortion, smaller for a barrel."
    )
    focal_relative: float | None = Field(
        description="Median over the images of the focal length over the longer side; null if all "
        "are panoramas."
    )


@dataclass(frozen=True)
class Verdict:
    """Result of the quality check.

    Attributes:
        grade: "good", "weak" (usable, with a warning) or "failed".
        reasons: The defects found; empty for "good".
        remedies: What to photograph or configure differently, without duplicates.
        worth_retrying: Whether another mapping attempt may give a better model.
    """

    grade: Grade
    reasons: list[str]
    remedies: list[str]
    worth_retrying: bool


@dataclass(frozen=True)
class _Finding:
    """A possible defect of a model.

    Attributes:
        found: Whether the model has the defect.
        worth_retrying: Whether another mapping attempt may remove the defect.
        prevents_retry: Whether no other attempt is made, whatever the other findings are.
    """

    found: bool
    reason: str
    remedy: str
    worth_retrying: bool = True
    prevents_retry: bool = False


def judge(evidence: Evidence | None, min_registered_share: float) -> Verdict:
    """Grade a reconstruction.

    Args:
        evidence: The statistics of the model; None if the mapper returned no model.
        min_registered_share: The share of registered images below which the model has failed.
    """
    if evidence is None:
        return Verdict(
            "failed",
            ["no relative pose between photographs could be estimated"],
            [_MORE, _MOVE, _TEXTURE],
            True,
        )
    for index, grade in enumerate(("failed", "weak")):
        only = _failures(evidence) if grade == "failed" else _weaknesses(evidence)
        findings = [*_findings(evidence, index, min_registered_share), *only]
        found = [finding for finding in findings if finding.found]
        if found:
            return Verdict(
                grade,  # type: ignore[arg-type]
                [f.reason for f in found],
                list(dict.fromkeys(f.remedy for f in found)),
                any(f.worth_retrying for f in found) and not any(f.prevents_retry for f in found),
            )
    return Verdict("good", [], [], False)


def _findings(e: Evidence, level: int, min_registered_share: float) -> list[_Finding]:
    """The defects that both grades have; ``level`` indexes the thresholds: 0 failed, 1 weak."""
    failed = level == 0
    share = e.registered / e.total
    folded = (
        e.agreeing_pairs < FOLDED_AGREEING and e.missing_covisibility > FOLDED_MISSING_COVISIBILITY
    )
    most_missing = MAX_MISSING_COVISIBILITY[level]
    if not failed and e.pairs_left_out:
        most_missing = MAX_MISSING_COVISIBILITY_LEFT_OUT
    elif not failed and min(e.agreeing_pairs, e.agreeing_distinctive) >= ALL_AGREE:
        most_missing = MAX_MISSING_COVISIBILITY_ALL_AGREE
    return [
        _Finding(
            share < (min_registered_share if failed else MIN_SHARE_GOOD),
            f"{e.registered} of {e.total} photographs got a pose",
            _MORE + f"; remove those that show something else; or {_OPTIONS}",
            e.registered < REGISTERED_SHARE_OF_COMPONENT * e.reachable,
        ),
        _Finding(
            e.explained_matches < MIN_EXPLAINED[level],
            f"only {e.explained_matches:.0%} of the verified matches fit the model",
            _FOCAL,
        ),
        _Finding(
            e.observations_per_image < MIN_OBSERVATIONS[level],
            f"a photograph observes only {e.observations_per_image:.0f} points on average",
            _TEXTURE + f"; or {_OPTIONS}",
        ),
        _Finding(
            e.agreeing_pairs < MIN_AGREEING_PAIRS[level] or (failed and folded),
            f"{1 - e.agreeing_pairs:.0%} of the strongest pairs of photographs contradict the "
            "model: different parts that look alike may have been merged",
            _REPEATED,
        ),
        _Finding(
            e.agreeing_distinctive < MIN_AGREEING_DISTINCTIVE[1 if e.pairs_left_out else level],
            f"{1 - e.agreeing_distinctive:.0%} of the pairs that share what no other photograph "
            "shows contradict the model: different parts that look alike may have been merged",
            _REPEATED,
        ),
        _Finding(
            e.missing_covisibility > most_missing and not (failed and folded),
            f"{e.missing_covisibility:.0%} of neighbouring photographs do not see the same points: "
            "different parts that look alike may have been merged",
            _REPEATED,
        ),
        _Finding(
            e.parallax < MIN_PARALLAX[level],
            "the camera only turned, or hardly moved: without parallax, depth is unknown",
            _MOVE,
            worth_retrying=False,
            prevents_retry=True,
        ),
    ]


def _contradicts_exif(e: Evidence) -> bool:
    """Whether the cost would rise clearly at the focal length from EXIF (a parabola through the
    rise at ``FOCAL_STEP``)."""
    if e.focal_certainty is None or e.focal_off is None:
        return True
    steps = math.log(max(e.focal_off, FOCAL_STEP)) / math.log(FOCAL_STEP)
    return e.focal_certainty * steps**2 >= MIN_FOCAL_CERTAINTY


def _determines_focal(e: Evidence) -> bool:
    """Whether the images determine the focal length: by a clear rise of the cost, or by the
    standard deviation that follows from the rise and the number of residuals."""
    if e.focal_certainty is None or e.focal_certainty >= MIN_FOCAL_CERTAINTY:
        return True
    free = 2 * e.observations_per_image - 3 * e.points / max(e.registered, 1)
    residuals = min(free, MAX_RESIDUALS_PER_IMAGE) * min(e.registered, FOCAL_IMAGES)
    steps = MAX_FOCAL_DEVIATION / (FOCAL_STEP - 1)
    return e.focal_certainty * residuals * steps**2 >= 1


def _failures(e: Evidence) -> list[_Finding]:
    """The defects of failed models alone."""
    return [
        _Finding(
            e.focal_relative is not None
            and not FOCAL_RANGE[0] <= e.focal_relative <= FOCAL_RANGE[1],
            f"the focal length is {e.focal_relative or 0:.2f} times the image's longer side",
            _FOCAL,
        ),
        _Finding(
            e.broken_steps > 0,
            f"the camera turns abruptly at {e.broken_steps} step(s) of a sequence, which the "
            "pairs across them contradict: different parts that look alike may have been merged",
            _REPEATED,
        ),
        _Finding(
            e.parallax < SMALL_PARALLAX
            and e.parallax < MIN_PARALLAX_PER_ANGLE * math.radians(e.median_angle_deg),
            "the camera hardly moved: the matches show too little parallax for the depths of the "
            "model",
            _MOVE,
        ),
        _Finding(
            e.behind_camera > MAX_BEHIND,
            f"{e.behind_camera:.0%} of the points are behind their cameras",
            _MOVE,
        ),
    ]


def _weaknesses(e: Evidence) -> list[_Finding]:
    """The defects of weak models alone."""
    off = e.focal_off or 1.0
    return [
        _Finding(
            e.focal_off is not None and off <= MAX_FOCAL_OFF and e.focal_certainty == 0,
            "the focal length agrees with EXIF, but another one fits the photographs better",
            _FOCAL,
        ),
        _Finding(
            e.pincushion > MAX_PINCUSHION,
            f"the lens distortion moves the edge of the image outwards by {e.pincushion - 1:.0%}, "
            "more than lenses do: the focal length may be wrong",
            _FOCAL,
        ),
        _Finding(
            off > MAX_FOCAL_OFF and not _contradicts_exif(e),
            f"the focal length differs from EXIF by a factor of {off:.1f}, and the photographs do "
            "not determine which one is correct",
            _FOCAL,
        ),
        _Finding(
            e.focal_off is None and not _determines_focal(e),
            "the photographs hardly determine the focal length: they show a plane from the front, "
            "the camera moved straight ahead, or they are not sharp",
            _FOCAL,
            False,
        ),
        _Finding(
            e.reprojection_px > MAX_REPROJECTION_WEAK_PX,
            f"the mean reprojection error is {e.reprojection_px:.1f} px",
            _TEXTURE,
        ),
        _Finding(
            e.median_angle_deg < MIN_ANGLE_WEAK_DEG,
            "the camera hardly moved: the median triangulation angle is "
            f"{e.median_angle_deg:.1f} degrees",
            _MOVE,
            False,
        ),
    ]
