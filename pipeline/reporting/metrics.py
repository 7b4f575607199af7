"""``metrics.json``: a scene's result in numbers, the same for the same work on any machine.

How long the stages took stands in their ``run.json``; ``with_times`` brings both together.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from pipeline.runtime.record import RunRecord, read_record, read_run

NAME = "metrics.json"


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="constants")


class ViewMetrics(_Record):
    """One measured view."""

    name: str = Field(description="The photograph's name.")
    psnr: float = Field(description="PSNR, dB.")
    ssim: float
    lpips: float | None = Field(description="null where it was not measured.")
    render: str = Field(description="File in `evaluate/renders/`.")


class Protocol(_Record):
    """How quality was measured; sentences for people."""

    resolution: list[str] = Field(description="Sizes of the views, `<width>x<height>` in pixels.")
    split: str = Field(description="Which views were measured.")
    poses_and_points: str
    num_views: int = Field(ge=1)
    psnr: str
    ssim: str
    lpips: str
    masks: str | None
    background: list[float] = Field(description="RGB in 0..1 behind transparent photographs.")
    exposure: str | None
    poses: str | None


class PoseErrors(_Record):
    """Pose errors against ground truth (see `pipeline.metrics.pose.PoseError`)."""

    rotation_median_deg: float | None
    rotation_mean_deg: float | None
    centre_median: float | None = Field(description="In the truth's unit.")
    centre_mean: float | None = Field(description="In the truth's unit.")
    centre_relative_median: float | None = Field(description="`centre_median` over `radius`.")
    radius: float | None = Field(description="RMS distance of the centres from their mean.")
    scale: float | None = Field(description="Truth units in one unit of the estimate.")
    auc: dict[str, float] | None = Field(description="Degrees to area under the recall curve.")
    num_common: int
    num_truth: int


class StageStatus(_Record):
    """Whether a stage of the plan has run."""

    skipped: bool
    reason: str = Field(description="Why it is needed, or is not.")


class Metrics(_Record):
    """A scene's result in numbers."""

    schema_version: Literal[1] = Field(1, description="Version of this file's format.")
    scene: str = Field(description="The run's name: a scene, alone or with configuration and seed.")
    seed: int | None
    psnr: float = Field(description="Mean PSNR of the measured views, dB.")
    ssim: float
    lpips: float | None
    lpips_reason: str = Field(description="Why LPIPS was not measured; empty where it was.")
    train_psnr: float | None = Field(
        description="Mean PSNR of a few training views, dB. Far above `psnr`: overfitting. Low "
        "itself: inconsistent photographs (moving objects, exposure changes, wrong poses)."
    )
    psnr_without_gains: float | None = Field(
        description="PSNR without the views' exposure gains; null where there are none."
    )
    per_view: list[ViewMetrics]
    protocol: Protocol
    num_gaussians: int = Field(ge=0)
    registered_images: int | None = Field(description="Photographs that have a pose.")
    total_images: int = Field(description="Photographs in the scene folder.")
    reprojection_error_px: float | None
    sfm_verdict: str | None = Field(description="good, weak or failed; null for given poses.")
    georeference: dict[str, Any] | None = Field(description="The world's frame, from sfm.")
    pose_error: PoseErrors | None = Field(description="null without ground truth.")
    stages: dict[str, StageStatus]
    versions: dict[str, str] = Field(description="Package to its version.")
    warnings: list[str]


def read_metrics(folder: Path) -> Metrics:
    """The metrics of a finished scene's folder (``results/<scene>``).

    Raises:
        UserError: they are missing or damaged.
    """
    return read_record(folder / "report" / NAME, Metrics)


def read_runs(metrics: Metrics, folder: Path, without: str = "") -> dict[str, RunRecord]:
    """The ``run.json`` of every stage that has run, by stage; ``without`` names one that has not
    finished yet.

    Raises:
        UserError: one is missing or damaged.
    """
    ran = (n for n, stage in metrics.stages.items() if not stage.skipped and n != without)
    return {name: read_run(folder / name) for name in ran}


def with_times(metrics: Metrics, runs: Mapping[str, RunRecord]) -> dict[str, Any]:
    """The metrics for people: with ``wall_s``, ``cpu_s`` and ``peak_rss_mb`` of each stage, zero
    for skipped ones. Work that was killed and resumed counts its earlier processes, too."""
    shown = metrics.model_dump(mode="json")
    for name, stage in shown["stages"].items():
        run = runs.get(name)
        stage["wall_s"] = 0.0 if run is None else round(run.wall_s + run.earlier_s, 3)
        stage["cpu_s"] = 0.0 if run is None else run.cpu_s
        stage["peak_rss_mb"] = 0.0 if run is None else run.peak_rss_mb
    return shown
