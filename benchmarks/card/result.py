"""The results of ``python -m benchmarks.card``, as stored in its record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from benchmarks import markdown

Status = Literal["measured", "not measured", "failed", "over its time"]


@dataclass(frozen=True)
class CardResult:
    """A part of the measurement.

    Attributes:
        part: One of ``benchmarks.card.plan.PARTS``.
        case: What it was measured at: the number of Gaussians and the size, or the threads.
        status: Whether there are figures.
        reason: Why there are none; empty if there are.
        wall_s: The wall time of the part's process.
        figures: Figures by name; the end of the name is the unit. Shares are of 1.
        facts: Names of devices and versions.
    """

    part: str
    case: str
    status: Status
    reason: str
    wall_s: float
    figures: dict[str, float] = field(default_factory=dict)
    facts: dict[str, str] = field(default_factory=dict)


def table(found: Sequence[CardResult]) -> str:
    """A row for each part."""
    rows = [["part", "case", "wall (s)", "figures"]]
    for r in found:
        named = [f"{name} {value:.4g}" for name, value in r.figures.items()]
        text = ", ".join(named) if r.status == "measured" else f"{r.status}: {r.reason}"
        rows.append([r.part, r.case or "-", f"{r.wall_s:.0f}", text.replace("|", "/") or "-"])
    return markdown.table(rows)
