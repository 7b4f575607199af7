"""The verdict on a scene in words, and the warnings ordered by cause.

No thresholds of its own: the grade of the poses is that of sfm, that of the renders is by
``pipeline.metrics.evaluate`` (photographs not reproduced, overfitting), and coverage counts what
most of the surface has.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from pipeline.coverage.record import CoverageRecord
from pipeline.metrics.evaluate import LOW_PSNR, LOW_TRAIN_PSNR, diagnose
from pipeline.reporting.metrics import Metrics

Grade = Literal["good", "weak", "failed"]

_WORST_FIRST: tuple[Grade, ...] = ("failed", "weak", "good")
TITLES: dict[Grade, str] = {"good": "Good", "weak": "Usable with care", "failed": "Failed"}
_REMEDY = re.compile(r"^(.*) \(to improve it: (.*)\)$", re.DOTALL)
_SIDE = re.compile(
    r"^(from|between) (.+?),.*?"
    r"(to the left|to the right|higher|lower|back|ahead)\b"
)
_BEYOND = {"higher": "above", "lower": "below", "back": "behind", "ahead": "in front of"}

# Heading of a group of warnings -> the stages whose warnings it has. The plan has no name.
_GROUPS = {
    "The photographs": ("", "inspect", "decode"),
    "Finding where they were taken": (
        *("features", "extract", "pairs", "match", "matches", "sfm", "refine", "undistort"),
    ),
    "Training": ("dense", "init", "coarse", "partition", "block", "polish", "train", "holes"),
    "Measured result": ("evaluate", "coverage"),
    "Files": ("export",),
}


class Figure(NamedTuple):
    """A figure of the verdict: its value, what it means, and its grade; None if it has none."""

    value: str
    meaning: str
    grade: Grade | None


@dataclass(frozen=True)
class Verdict:
    """The verdict on a scene.

    Attributes:
        grade: The worst grade of poses and renders.
        title: The grade in words.
        sentence: What is placed, how sharp it is, and what was not seen.
        figures: At most three.
    """

    grade: Grade
    title: str
    sentence: str
    figures: Sequence[Figure]


class WarningGroup(NamedTuple):
    """Warnings of successive stages, in the order in which the stages run; ``remedies`` is what
    to do about them."""

    title: str
    warnings: Sequence[str]
    remedies: Sequence[str]


def render_grade(metrics: Metrics) -> Grade:
    """The grade of the renders.

    failed: training photographs are not reproduced (``LOW_TRAIN_PSNR``; test photographs, if no
    training view was measured). weak: overfitting, or test views below ``LOW_PSNR``.
    """
    train = metrics.psnr if metrics.train_psnr is None else metrics.train_psnr
    if train < LOW_TRAIN_PSNR:
        return "failed"
    return "weak" if metrics.psnr < LOW_PSNR or diagnose(metrics.psnr, train) else "good"


def grade_of(metrics: Metrics) -> Grade:
    """The worst of the grades of poses and renders."""
    return worst([metrics.sfm_verdict, render_grade(metrics)])


def worst(grades: Collection[str | None]) -> Grade:
    """The worst of the grades that are known; good without one."""
    return next((grade for grade in _WORST_FIRST if grade in grades), "good")


def verdict(metrics: Metrics, record: CoverageRecord | None = None) -> Verdict:
    """The verdict on a scene, and on its coverage if it is given."""
    grade = grade_of(metrics)
    figures = [_placed_figure(metrics), _error_figure(metrics), _seen_figure(record)]
    clauses = [_placed(metrics), _sharpness(metrics), _not_seen(record), _contradicted(record)]
    return Verdict(
        grade,
        TITLES[grade],
        "; ".join(filter(None, clauses)) + ".",
        [figure for figure in figures if figure is not None],
    )


def _placed(metrics: Metrics) -> str:
    placed, total = metrics.registered_images, metrics.total_images
    if not placed:
        return ""
    some = f"all {total}" if placed == total else f"{placed} of {total}"
    doubt = ", but their positions are uncertain" if metrics.sfm_verdict == "weak" else ""
    return f"{some} photographs placed{doubt}"


def _sharpness(metrics: Metrics) -> str:
    match render_grade(metrics):
        case "good":
            return "sharp where photographed"
        case "failed":
            return "the photographs are not reproduced"
        case _:
            return "sharp at the photographs, blurred or wrong between them"


def _not_seen(record: CoverageRecord | None) -> str:
    """What the photographs show least, by the first proposed viewpoint."""
    if record is None or not record.viewpoints or record.viewpoints[0].unknown_percent < 50:
        return ""
    found = _SIDE.match(record.viewpoints[0].description)
    if found is None:
        return "the surroundings were hardly seen"
    between, name, side = found.groups()
    where = f"{_BEYOND.get(side, side + ' of')} {name}"
    if between == "between":
        where = f"between {name}"
    return f"what lies {where} was hardly seen"


def _contradicted(record: CoverageRecord | None) -> str:
    """Floaters and veils beside the photographs' places, if they are conspicuous."""
    found = None if record is None else record.novel_views
    if found is None or not found.is_conspicuous:
        return ""
    percent = f"{100 * found.contradicted_share:.0f} %"
    return f"beside the photographs' places, {percent} of what one sees contradicts them"


def _placed_figure(metrics: Metrics) -> Figure | None:
    placed, total = metrics.registered_images, metrics.total_images
    if not placed:
        return None
    grade: Grade = "weak" if metrics.sfm_verdict == "weak" or placed < total else "good"
    return Figure(f"{placed:,} of {total:,}", "photographs placed", grade)


def _error_figure(metrics: Metrics) -> Figure | None:
    if not metrics.per_view:
        return None
    error = 100 * 10 ** (-metrics.psnr / 20)
    meaning = "colour error in photographs kept aside for checking"
    return Figure(f"{error:.2g} %", meaning, render_grade(metrics))


def _seen_figure(record: CoverageRecord | None) -> Figure | None:
    if record is None or record.surface is None:
        return None
    share = record.surface.seen_by.three_or_more
    meaning = "of the visible surface is in three or more photographs"
    return Figure(f"{100 * share:.0f} %", meaning, "good" if share > 0.5 else "weak")


def grouped_warnings(warnings: Sequence[str], order: Sequence[str]) -> list[WarningGroup]:
    """Warnings by cause: groups and warnings in the order of the DAG, each text once.

    Args:
        warnings: Texts as in ``metrics.json``: those of stages begin with the stage's name.
        order: The stages in the order of the DAG.
    """
    found: list[tuple[str, str]] = []
    for text in dict.fromkeys(warnings):
        stage, colon, rest = text.partition(": ")
        known = bool(colon) and stage in order
        found.append((stage, rest) if known else ("", text))
    places = {name: place for place, name in enumerate(order)}
    found.sort(key=lambda entry: places.get(entry[0], -1))
    groups = []
    for title, stages in _GROUPS.items():
        told: list[str] = []
        remedies: list[str] = []
        for stage, text in found:
            if stage in stages and (split := _REMEDY.match(text)):
                told.append(split[1])
                remedies += split[2].split("; ")
            elif stage in stages:
                told.append(text)
        if told:
            groups.append(
                WarningGroup(title, list(dict.fromkeys(told)), list(dict.fromkeys(remedies)))
            )
    return groups
