"""Runs of structure from motion, their medians, and the table of them."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from benchmarks import markdown
from benchmarks.markdown import cell
from pipeline.metrics.pose import PoseError

REFERENCE = "pycolmap"
STEPS = ("features", "matches", "mapping")
HEADING = [
    *("scene", "configuration", *STEPS, "CPU s", "of pycolmap's", "rotation, deg", "centre"),
    *("of the radius, permille", "AUC@1", "images", "MiB"),
]


@dataclass(frozen=True)
class Cost:
    """The CPU seconds of a step, without imports, and its peak memory, MiB."""

    cpu_s: float
    peak_mb: float


@dataclass(frozen=True)
class Run:
    """One run of a configuration.

    Attributes:
        planned: Whether the configuration is the choice of the plan.
        costs: The cost of each step.
        registered: The number of photographs with a pose.
        error: The errors against the scene's poses; None if there is no model.
        failure: The reason why there is no model.
    """

    scene: str
    configuration: str
    planned: bool
    costs: dict[str, Cost]
    registered: int
    error: PoseError | None
    failure: str = ""

    @property
    def cpu_s(self) -> float:
        return sum(cost.cpu_s for cost in self.costs.values())


@dataclass(frozen=True)
class Summary:
    """The medians over the runs of a configuration on a scene, of those that gave a model.

    Attributes:
        cpu_s: The CPU seconds of each step; ``total_s`` is their sum.
        rotation_deg, centre, centre_permille, auc1: The median errors over the images in degrees,
            the world's unit and thousandths of the cameras' radius; the area under the curve of
            relative pose errors up to one degree. None without any model.
        runs, failed: The number of runs, and of those without a model.
    """

    scene: str
    configuration: str
    planned: bool
    cpu_s: dict[str, float]
    total_s: float
    peak_mb: float
    registered: int
    rotation_deg: float | None
    centre: float | None
    centre_permille: float | None
    auc1: float | None
    runs: int
    failed: int


def summaries(runs: Sequence[Run]) -> list[Summary]:
    """A summary of each configuration on each scene, in the order of the first runs."""
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.scene, run.configuration), []).append(run)
    return [summarise(group) for group in groups.values()]


def summarise(runs: Sequence[Run]) -> Summary:
    """The summary of at least one run of a configuration on a scene."""
    done = [run for run in runs if run.error is not None]
    timed = done or list(runs)

    def middle(of: Callable[[PoseError], float | None]) -> float | None:
        values = [
            value for run in done if run.error is not None and (value := of(run.error)) is not None
        ]
        return statistics.median(values) if values else None

    steps = {
        step: statistics.median(run.costs[step].cpu_s for run in timed if step in run.costs)
        for step in STEPS
        if any(step in run.costs for run in timed)
    }
    relative = middle(lambda error: error.centre_relative_median)
    return Summary(
        scene=runs[0].scene,
        configuration=runs[0].configuration,
        planned=runs[0].planned,
        cpu_s=steps,
        total_s=statistics.median(run.cpu_s for run in timed),
        peak_mb=max((c.peak_mb for run in runs for c in run.costs.values()), default=0.0),
        registered=int(statistics.median(run.registered for run in timed)),
        rotation_deg=middle(lambda error: error.rotation_median_deg),
        centre=middle(lambda error: error.centre_median),
        centre_permille=None if relative is None else 1000 * relative,
        auc1=middle(lambda error: None if error.auc is None else error.auc[1.0]),
        runs=len(runs),
        failed=len(runs) - len(done),
    )


def table(found: Sequence[Summary]) -> str:
    """A Markdown table by scene and configuration; times are relative to pycolmap's defaults."""
    reference = {s.scene: s.total_s for s in found if s.configuration == REFERENCE}
    rows = [HEADING]
    for s in found:
        ratio = s.total_s / reference[s.scene] if s.scene in reference else None
        steps = [s.cpu_s.get(step) for step in STEPS]
        rows.append(
            [
                s.scene,
                f"**{s.configuration}**" if s.planned else s.configuration,
                *(cell(value, ".1f") for value in [*steps, s.total_s]),
                cell(ratio, ".2f"),
                cell(s.rotation_deg, ".4f"),
                cell(s.centre, ".4g"),
                cell(s.centre_permille, ".3f"),
                cell(s.auc1, ".3f"),
                f"{s.registered}" + (f" ({s.failed} of {s.runs} runs failed)" if s.failed else ""),
                f"{s.peak_mb:.0f}",
            ]
        )
    return markdown.table(rows)
