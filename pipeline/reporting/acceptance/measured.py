"""The figures of a result that rules compare, and those of the baseline."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field, ValidationError

from pipeline.coverage.record import CoverageRecord
from pipeline.io.bounded import MIB, read_bounded
from pipeline.metrics.evaluation import ProtocolDescription
from pipeline.reporting.metrics import Metrics, TimedMetrics, read_metrics, read_runs, with_times
from pipeline.reporting.verdict import grade_of
from pipeline.runtime.errors import UserError
from pipeline.runtime.json_file import JsonObject, first_error
from pipeline.runtime.suggest import check_exists

_MAX_BYTES = 512 * MIB
_FIX = "name the accepted.json, the results folder or the metrics.json of a finished scene"
# The parts of a protocol that must be the same for two results to be comparable, and their names.
_PROTOCOL = {
    "resolution": "resolution",
    "split": "split",
    "psnr": "definition of PSNR",
    "ssim": "definition of SSIM",
    "masks": "use of masks",
    "background": "background",
    "exposure": "use of exposure gains",
    "appearance": "fit of appearance",
    "poses": "fit of test poses",
}


class Measured(JsonObject):
    """The figures of a result that rules compare. A figure that was not measured is null."""

    scene: str = Field(description="The run's name: a scene, alone or with configuration and seed.")
    views: tuple[str, ...] = Field(description="The names of the measured views.")
    protocol: ProtocolDescription = Field(description="How quality was measured.")
    has_test_views: bool = Field(description="Whether the measured views were not trained on.")
    registered_share: float | None = Field(description="Share of the photographs with a pose.")
    verdict: Literal["good", "weak", "failed"] = Field(description="The verdict of the page.")
    psnr: float = Field(description="Mean PSNR of the measured views, dB.")
    ssim: float = Field(description="Mean SSIM of the measured views.")
    seen_share: float | None = Field(
        description="Share of the visible surface that three or more photographs show."
    )
    gaps: int = Field(description="Number of gaps between parts that could not be joined.")
    contradicted_share: float | None = Field(
        description="Share of the pixels of novel views that contradict the photographs."
    )
    floaters: int | None = Field(description="Number of opaque Gaussians in front of cameras.")
    gaussians: int = Field(description="Number of trained Gaussians.")
    file_psnr: float | None = Field(
        None,
        description="Lowest PSNR of a compressed file against the exact Gaussians, dB.",
    )
    residual_m: float | None = Field(
        description="Median horizontal residual of the georeference, metres."
    )
    minutes: float | None = Field(description="Time of all stages.")
    memory_mb: float | None = Field(description="Peak memory of any stage, MB.")
    warnings: int = Field(description="Number of warnings.")


def measured_of(metrics: Metrics, coverage: CoverageRecord | None = None) -> Measured:
    """The figures of a result: time and memory of ``TimedMetrics`` alone, and those of its coverage
    if it is given."""
    placed, total = metrics.registered_images, metrics.total_images
    residuals = metrics.georeference and metrics.georeference.residuals_m
    surface = coverage and coverage.surface
    novel = coverage and coverage.novel_views
    floaters = coverage and coverage.floaters
    timed = [*metrics.stages.values()] if isinstance(metrics, TimedMetrics) else []
    return Measured(
        scene=metrics.scene,
        views=tuple(view.name for view in metrics.per_view),
        protocol=metrics.protocol,
        has_test_views=metrics.train_psnr is not None,
        registered_share=None if placed is None or not total else placed / total,
        verdict=grade_of(metrics),
        psnr=metrics.psnr,
        ssim=metrics.ssim,
        seen_share=surface.seen_by.three_or_more if surface else None,
        gaps=len(metrics.gaps),
        contradicted_share=novel.contradicted_share if novel else None,
        floaters=floaters.num_gaussians if floaters else None,
        gaussians=metrics.num_gaussians,
        file_psnr=min((loss.psnr for loss in metrics.exported), default=None),
        residual_m=residuals.horizontal_median if residuals else None,
        minutes=sum(stage.wall_s for stage in timed) / 60 if timed else None,
        memory_mb=max(stage.peak_rss_mb for stage in timed) if timed else None,
        warnings=len(metrics.warnings),
    )


def measured_in(folder: Path) -> Measured:
    """The figures of a finished scene.

    Args:
        folder: ``results/<scene>``.

    Raises:
        UserError: A record of the scene is missing or damaged.
    """
    check_exists(folder)
    metrics = read_metrics(folder)
    timed = with_times(metrics, read_runs(metrics, folder))
    return measured_of(timed, CoverageRecord.read(folder / "coverage"))


class _Accepted(BaseModel):
    """The part of an ``accepted.json`` that a later judgement needs."""

    measured: Measured


def read_baseline(path: Path) -> Measured:
    """The figures to compare with.

    Args:
        path: An ``accepted.json``, a ``metrics.json`` or the folder of a result.

    Raises:
        UserError: It is missing, damaged, or something else.
    """
    check_exists(path, _FIX)
    if path.is_dir():
        return measured_in(path)
    data = read_bounded(path, _MAX_BYTES, fix=_FIX)
    try:
        content = json.loads(data)
        if isinstance(content, dict) and "measured" in content:
            return _Accepted.model_validate_json(data).measured
        return measured_of(Metrics.model_validate_json(data))
    except ValidationError as error:
        found = first_error(error)
    except (ValueError, RecursionError) as error:
        found = str(error)
    what = f"expected a baseline, an accepted.json or a metrics.json, found another file ({found})"
    raise UserError(what, file=path, fix=_FIX)


def differences(measured: Measured, baseline: Measured) -> list[str]:
    """Why two results cannot be compared, a clause for each reason; empty if they can."""
    found = []
    scenes = [result.scene.partition("@")[0] for result in (baseline, measured)]
    if scenes[0] != scenes[1]:
        found.append(f"scene {scenes[0]} instead of {scenes[1]}")
    for field, name in _PROTOCOL.items():
        theirs, ours = (getattr(result.protocol, field) for result in (baseline, measured))
        if theirs != ours:
            found.append(f"{name} {_plain(theirs)} instead of {_plain(ours)}")
    theirs, ours = baseline.views, measured.views
    if {*theirs} != {*ours}:
        found.append(f"{len(theirs)} measured views instead of {len(ours)}, or other ones")
    return found


def _plain(value: object) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    return "none" if value is None else f"'{value}'"
