"""The verdict on poses by their uncertainty."""

from __future__ import annotations

from dataclasses import replace

from pipeline.runtime.text import counted
from pipeline.sfm.judge import MIN_SHARE_GOOD, Verdict
from pipeline.sfm.matching import list_names
from pipeline.sfm.uncertainty_file import UncertaintySummary

#: The largest standard deviation of a photograph's position, as a share of its baseline, that is
#: certain: depths by the photograph are then off by about this share. Sound models are below 0.03.
MAX_BASELINE_SHARE = 0.05
REMEDY = (
    "photograph what these show again from both sides of each, a step apart, so that photographs "
    "overlap by two thirds"
)


def with_uncertainty(
    verdict: Verdict, found: UncertaintySummary | None, registered: int
) -> tuple[Verdict, list[str]]:
    """A verdict that is at most weak if too many of the registered photographs are uncertain, and
    warnings about few."""
    if found is None or not found.uncertain:
        return verdict, []
    names = found.uncertain
    reason = (
        f"the positions of {counted(len(names), 'photograph')} are uncertain by more than "
        f"{MAX_BASELINE_SHARE:.0%} of the baselines: {list_names(names)}"
    )
    if len(names) <= (1 - MIN_SHARE_GOOD) * registered:
        return verdict, [f"{reason} (to improve them: {REMEDY})"]
    reasons, remedies = [*verdict.reasons, reason], [*verdict.remedies, REMEDY]
    grade = "weak" if verdict.grade == "good" else verdict.grade
    return replace(verdict, grade=grade, reasons=reasons, remedies=remedies), []
