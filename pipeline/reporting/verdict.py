"""The verdict on a scene: one grade and one sentence, for people who do not know the measures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pipeline.coverage.record import CoverageRecord
from pipeline.reporting.metrics import Metrics
from pipeline.runtime.text import counted

Grade = Literal["good", "weak", "poor"]

# PSNR in dB of the test views, and with it the root mean square error in percent of full range:
# 25 dB is 5.6 %, at which renders look as their photographs do but for fine texture; 20 dB is 10 %,
# at which shapes are blurred.
_SHARP_DB, _BLURRED_DB = 25.0, 20.0
# Shares: of photographs without a pose, and of pixels of test views that show a hole.
_UNPLACED, _HOLES = 0.1, 0.05
# Share of the surface that only one photograph shows, from which it is mentioned.
_SEEN_ONCE = 0.1


@dataclass(frozen=True)
class Verdict:
    """A judgement of a scene.

    Attributes:
        grade: "good" if most photographs are placed in a good model and test views are sharp;
            "poor" if test views are blurred; otherwise "weak".
        sentence: The grade with its reasons.
    """

    grade: Grade
    sentence: str


def judge(metrics: Metrics, coverage: CoverageRecord | None = None) -> Verdict:
    """Judge a finished scene by its poses, the PSNR of its test views, and its coverage."""
    grades: list[Grade] = ["good"]
    reasons = []
    total, placed = metrics.total_images, metrics.registered_images
    left = 0 if placed is None else total - placed
    if placed is not None:
        which = f"{placed:,} of" if left else "all"
        reasons.append(f"{which} {counted(total, 'photograph')} placed")
    if left > _UNPLACED * total:
        grades.append("weak")
    elif metrics.sfm_verdict not in (None, "good"):
        grades.append("weak")
        reasons.append("their positions are uncertain")
    reasons.append(_sharpness(metrics))
    if metrics.psnr < _SHARP_DB:
        grades.append("poor" if metrics.psnr < _BLURRED_DB else "weak")
    if coverage is not None:
        holes = [view.hole_share for view in coverage.views]
        share = sum(holes) / len(holes) if holes else 0.0
        if share > _HOLES:
            grades.append("weak")
            reasons.append(f"holes in {share:.0%} of the picture where nothing was photographed")
        elif coverage.surface and coverage.surface.seen_by.one > _SEEN_ONCE:
            once = coverage.surface.seen_by.one
            reasons.append(f"{once:.0%} of the surface is in one photograph only")
    order: list[Grade] = ["poor", "weak", "good"]
    grade = min(grades, key=order.index)
    return Verdict(grade, f"{grade.capitalize()}: {'; '.join(reasons)}")


def _sharpness(metrics: Metrics) -> str:
    if metrics.psnr >= _SHARP_DB:
        return "sharp where photographed"
    known = metrics.train_psnr is not None and metrics.train_psnr >= _SHARP_DB
    how = "blurred" if metrics.psnr < _BLURRED_DB else "soft"
    if known:
        return f"sharp from where the photographs were taken, {how} in between"
    return f"{how}, and unlike the photographs in places"
