"""Is a reconstruction to be believed?

A failed one can register every image at 0.3 px: a wrong focal length bends the scene and drops
what does not fit, and where two sides of a building look alike it is folded onto itself, so the
residual of what is left says little. Other things say more: what was dropped, whether the pairs of
photographs agree, each for itself, whether neighbours see the same things, and whether the
geometry could have told a wrong focal length at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Grade = Literal["good", "weak", "failed"]

# Bounds on the evidence, (failed, weak), from the corpus of ``benchmarks.judge`` (docs/judge.md):
# each lies between what right models and what wrong ones show there, nearer to the wrong ones.
MIN_EXPLAINED = (0.20, 0.40)
MIN_OBSERVATIONS = (15, 60)
MIN_AGREEING_PAIRS = (0.93, 0.98)
MAX_STRANGERS = (0.35, 0.15)
# Both signs of a folded model together, each of which alone would pass as weak.
FOLDED_AGREEING, FOLDED_STRANGERS = 0.97, 0.15
# Matches that a camera which only turns would see as well, but for noise (half a pixel).
MIN_PARALLAX = (0.0018, 0.004)
MAX_BEHIND = 0.01
# A lens from 8 mm to 600 mm on 35 mm film: focal length over the longer side.
FOCAL_RANGE = (0.22, 17.0)
# EXIF is rounded by a few per cent; beyond this the picture was cropped, or the model is wrong.
MAX_FOCAL_OFF = 1.3
# Less of a rise in cost for a focal length 20% off: the photographs do not tell it. Right models of
# things with depth show 0.3 and more, planes and straight drives 0.06 and less.
MIN_FOCAL_CERTAINTY = 0.1
MIN_SHARE_GOOD = 0.8
MAX_REPROJECTION_WEAK_PX = 2.0
# Half of the points seen under less than this: the camera hardly moved, depths are guesses.
MIN_ANGLE_WEAK_DEG = 2.0
# As many of the photographs that pairs link have a pose: mapping them again gains none.
REACHED = 0.9

_MORE = (
    "take more photographs around the subject, each sharing at least two thirds with the one before"
)
_OPTIONS = "raise features.max_features and matches.neighbours, or set matches.pairs: exhaustive"
_MOVE = "move sideways around the subject between photographs instead of turning on the spot"
_TEXTURE = "photograph something with texture, sharply and in unchanging light"
_FOCAL = (
    "keep the original files with their EXIF, use one lens and zoom, and add photographs from "
    "higher, lower and closer that see depth"
)
_ALIKE = (
    "add photographs that show the parts that look alike together with their surroundings, and "
    "turn corners in small steps"
)


@dataclass(frozen=True)
class Evidence:
    """What there is to see of a model.

    Attributes:
        registered, total: images.
        reachable: images in the largest set that verified pairs hold together.
        points, observations_per_image, mean_track_length, reprojection_px: of the model.
        explained_matches: share of verified matches between registered images whose two keypoints
            are seen as one point.
        agreeing_matches, agreeing_pairs: shares of the verified matches, and of the strong pairs,
            that agree with the epipolar geometry which the model gives them.
        strangers: share of neighbouring views that hardly see one another's points again.
        behind_camera: share of observations behind the camera that made them.
        parallax: how far matches are from what a camera that only turns would see, over the
            longer side.
        median_angle_deg: of the points, the largest angle between two of their rays, the median.
        focal_off: ratio of the focal length to its EXIF prior, either way up, of the median image
            with a prior; None without any (pictures cropped after they were taken have wrong ones).
        focal_certainty: share by which the cost rises for a focal length 20% off; None, not asked,
            where EXIF agrees.
        focal_relative: focal length over the longer side, of the median image.
        focal_prior_px: camera id -> EXIF prior.
    """

    registered: int
    total: int
    reachable: int
    points: int
    observations_per_image: float
    mean_track_length: float
    reprojection_px: float
    explained_matches: float
    agreeing_matches: float
    agreeing_pairs: float
    strangers: float
    behind_camera: float
    parallax: float
    median_angle_deg: float
    focal_off: float | None
    focal_certainty: float | None
    focal_relative: float
    focal_prior_px: dict[int, float]


@dataclass(frozen=True)
class Verdict:
    """Attributes:
    reasons: what speaks against the model.
    remedies: what to photograph or change, one for each reason, each once.
    curable: mapping again, another way, may give a better model.
    """

    grade: Grade
    reasons: list[str]
    remedies: list[str]
    curable: bool


@dataclass(frozen=True)
class _Finding:
    """One thing that speaks against a model, where ``hit``. ``curable``: mapping again may take it
    away; ``final``: whatever else it takes away is not worth it."""

    hit: bool
    reason: str
    remedy: str
    curable: bool = True
    final: bool = False


def judge(evidence: Evidence | None, min_registered_share: float) -> Verdict:
    """The verdict on a model, None being no model at all."""
    if evidence is None:
        return Verdict(
            "failed",
            ["no photographs could be put in relation to each other"],
            [_MORE, _MOVE, _TEXTURE],
            True,
        )
    for index, grade in enumerate(("failed", "weak")):
        found = [f for f in _findings(evidence, index, min_registered_share) if f.hit]
        if found:
            return Verdict(
                grade,  # type: ignore[arg-type]
                [f.reason for f in found],
                list(dict.fromkeys(f.remedy for f in found)),
                any(f.curable for f in found) and not any(f.final for f in found),
            )
    return Verdict("good", [], [], False)


def _findings(e: Evidence, which: int, min_registered_share: float) -> list[_Finding]:
    """What could speak against a model; ``which``: 0 asks for failure, 1 for weakness."""
    failed = which == 0
    share = e.registered / e.total
    folded = e.agreeing_pairs < FOLDED_AGREEING and e.strangers > FOLDED_STRANGERS
    off = e.focal_off or 1.0
    told = e.focal_certainty is None or e.focal_certainty >= MIN_FOCAL_CERTAINTY
    findings = [
        _Finding(
            share < (min_registered_share if failed else MIN_SHARE_GOOD),
            f"{e.registered} of {e.total} photographs got a pose",
            _MORE + f"; leave out those that show something else; or {_OPTIONS}",
            e.registered < REACHED * e.reachable,
        ),
        _Finding(
            e.explained_matches < MIN_EXPLAINED[which],
            f"only {e.explained_matches:.0%} of the verified matches fit the model",
            _FOCAL,
        ),
        _Finding(
            e.observations_per_image < MIN_OBSERVATIONS[which],
            f"a photograph sees only {e.observations_per_image:.0f} points",
            _TEXTURE + f"; or {_OPTIONS}",
        ),
        _Finding(
            e.agreeing_pairs < MIN_AGREEING_PAIRS[which] or (failed and folded),
            f"{1 - e.agreeing_pairs:.0%} of the strongest pairs of photographs contradict the "
            "model: parts that look alike may have been taken for one another",
            _ALIKE,
        ),
        _Finding(
            e.strangers > MAX_STRANGERS[which] and not (failed and folded),
            f"{e.strangers:.0%} of neighbouring photographs do not see the same things: parts that "
            "look alike may have been taken for one another",
            _ALIKE,
        ),
        _Finding(
            e.parallax < MIN_PARALLAX[which],
            "the camera only turned, or hardly moved: nothing shows how far away things are",
            _MOVE,
            curable=False,
            final=True,
        ),
    ]
    if failed:
        return [
            *findings,
            _Finding(
                not FOCAL_RANGE[0] <= e.focal_relative <= FOCAL_RANGE[1],
                f"the focal length is {e.focal_relative:.2f} times the picture's longer side",
                _FOCAL,
            ),
            _Finding(
                e.behind_camera > MAX_BEHIND,
                f"{e.behind_camera:.0%} of the points are behind their cameras",
                _MOVE,
            ),
        ]
    return [
        *findings,
        _Finding(
            off > MAX_FOCAL_OFF and not told,
            f"the focal length is {off:.1f} times off the one in EXIF, and the photographs do not "
            "tell which is right",
            _FOCAL,
        ),
        _Finding(
            e.focal_off is None and not told,
            "the photographs hardly tell the focal length: they show a plane from the front, the "
            "camera went straight ahead, or they are not sharp",
            _FOCAL,
            False,
        ),
        _Finding(
            e.reprojection_px > MAX_REPROJECTION_WEAK_PX,
            f"the points miss their keypoints by {e.reprojection_px:.1f} px",
            _TEXTURE,
        ),
        _Finding(
            e.median_angle_deg < MIN_ANGLE_WEAK_DEG,
            "the camera hardly moved: half of the points are seen within "
            f"{e.median_angle_deg:.1f} degrees",
            _MOVE,
            False,
        ),
    ]
