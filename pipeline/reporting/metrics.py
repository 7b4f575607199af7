"""``metrics.json``: a scene's result in numbers, the same for the same work on any machine.

The times of the stages are in their ``run.json``; ``with_times`` adds them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from pipeline.export.counters import FileLoss
from pipeline.holes.record import InventedSummary
from pipeline.metrics.evaluation import SceneQuality
from pipeline.plan.values import job_folders
from pipeline.runtime.json_file import JsonFile, JsonObject
from pipeline.runtime.record import RunRecord, read_run
from pipeline.scene.georeference import GeoreferenceSummary
from pipeline.sfm.counters import ComponentSummary, Gap
from pipeline.sfm.uncertainty_file import UncertaintySummary


class StageStatus(JsonObject):
    """Whether a stage of the plan has run."""

    skipped: bool = Field(description="Whether the plan leaves it out.")
    reason: str = Field(description="Why it is needed, or is not.")
    jobs: int = Field(1, ge=1, description="Number of its jobs, which share its work.")


class Metrics(JsonFile, SceneQuality):
    """A scene's result in numbers."""

    file_name: ClassVar[str] = "metrics.json"

    schema_version: Literal[1] = Field(1, description="Version of this file's format.")
    scene: str = Field(description="The run's name: a scene, alone or with configuration and seed.")
    input: str = Field(description="What the scene folder holds, in one line.")
    seed: int | None = Field(description="Of the run.")
    num_gaussians: int = Field(ge=0, description="Number of trained Gaussians.")
    invented: InventedSummary | None = Field(
        None, description="What `holes.fill` invented; null without. No other measure counts it."
    )
    device: Literal["cpu", "gpu"] = Field("cpu", description="What trained the scene.")
    registered_images: int | None = Field(description="Photographs that have a pose.")
    total_images: int = Field(
        description="Photographs in the scene folder, and frames chosen of its videos."
    )
    reprojection_error_px: float | None = Field(
        description="Mean over the sparse points; null if no stage computed it."
    )
    sfm_verdict: str | None = Field(description="good, weak or failed; null for given poses.")
    pose_uncertainty: UncertaintySummary | None = Field(
        None, description="Standard deviations of the poses, from sfm; null for given poses."
    )
    georeference: GeoreferenceSummary | None = Field(
        description="The world's frame, from sfm; null for given poses."
    )
    components: list[ComponentSummary] = Field(
        [], description="The parts of the scene that could not be joined; empty for given poses."
    )
    gaps: list[Gap] = Field(
        [], description="What to photograph to join the other parts to the one that is used."
    )
    stages: dict[str, StageStatus] = Field(description="By name of the stage.")
    versions: dict[str, str] = Field(description="Package to its version.")
    exported: list[FileLoss] = Field(
        [], description="What each compressed file of Gaussians loses."
    )
    warnings: list[str] = Field(description="Of the plan and of all stages.")


class TimedStage(StageStatus):
    """Whether a stage has run, and its cost."""

    wall_s: float = 0.0
    cpu_s: float | None = Field(
        0.0, description="null for resumed work: that of earlier processes is not recorded."
    )
    peak_rss_mb: float = 0.0


class TimedMetrics(Metrics):
    """A scene's result in numbers, with the cost of each stage."""

    stages: dict[str, TimedStage]  # type: ignore[assignment]


def read_metrics(folder: Path) -> Metrics:
    """The metrics of a finished scene's folder (``results/<scene>``).

    Raises:
        UserError: The metrics are missing or damaged.
    """
    return Metrics.read(folder / "report")


def read_runs(metrics: Metrics, folder: Path, without: str = "") -> dict[str, RunRecord]:
    """The ``run.json`` of every stage that has run, by stage; ``without`` names one that has not
    finished yet.

    Raises:
        UserError: A record is missing or damaged.
    """
    return {
        name: together([read_run(folder / job) for job in job_folders(name, stage.jobs)])
        for name, stage in metrics.stages.items()
        if not stage.skipped and name != without
    }


def together(runs: Sequence[RunRecord]) -> RunRecord:
    """The runs of a stage's jobs as one: times are summed, memory is the largest."""
    if len(runs) == 1:
        return runs[0]
    summed = {name: sum(getattr(run, name) for run in runs) for name in ("wall_s", "cpu_s")}
    summed["earlier_s"] = sum(run.earlier_s for run in runs)
    peak = max(run.peak_rss_mb for run in runs)
    return runs[-1].model_copy(update={**summed, "peak_rss_mb": peak, "curve_seconds": None})


def with_times(metrics: Metrics, runs: Mapping[str, RunRecord]) -> TimedMetrics:
    """The metrics with the times of each stage, which are zero for skipped ones. Work that was
    killed and resumed counts its earlier processes, too, whose CPU time is not known."""
    shown = metrics.model_dump()
    for name, run in runs.items():
        shown["stages"][name] |= {
            "wall_s": round(run.wall_s + run.earlier_s, 3),
            "cpu_s": None if run.earlier_s else run.cpu_s,
            "peak_rss_mb": run.peak_rss_mb,
        }
    return TimedMetrics.model_validate(shown)
