"""Reads the content of a scene's page from the outputs of its stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline.coverage.record import CoverageRecord, ProposedViewpoint, ViewCoverage
from pipeline.metrics.evaluation import Evaluation
from pipeline.metrics.protocol import Protocol
from pipeline.photos.load import load_view
from pipeline.plan.record import PlanRecord
from pipeline.reporting.data import (
    BlockRun,
    BlocksSection,
    Comparison,
    CoverageSection,
    ReportData,
    TrainedScene,
    TrainingRecord,
    ranked,
)
from pipeline.reporting.metrics import together
from pipeline.runtime.counters import read_counters
from pipeline.runtime.json_file import mismatch
from pipeline.runtime.record import read_run, read_stage
from pipeline.scene.blocks import Partition
from pipeline.scene.georeference import Georeference
from pipeline.scene.manifest import Manifest
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View
from pipeline.splats.arrays import GaussianArrays
from pipeline.training.loop.counters import TrainCounters
from pipeline.training.loop.curve import TrainingCurve


@dataclass(frozen=True)
class SceneResults:
    """Outputs of the stages of a scene.

    Attributes:
        metrics: the content of ``metrics.json`` with the times of the stages.
        folders: role -> the stage's folder: inspect, poses, train, evaluate and coverage.
        manifest: photographs of the views.
        model: cameras (refined, if training refines them) and sparse points.
        protocol: of the evaluation. antialias: as in training.
    """

    scene: str
    metrics: Mapping[str, Any]
    plan: PlanRecord
    folders: Mapping[str, Path]
    manifest: Manifest
    model: Reconstruction
    views: list[View]
    gaussians: GaussianArrays
    protocol: Protocol
    antialias: bool


def report_data(results: SceneResults, evaluation: Evaluation, shown: int) -> ReportData:
    """The content of the page.

    Args:
        evaluation: of views of the scene.
        shown: number of views shown with their photographs.

    Raises:
        UserError: an output of a stage is missing, damaged, or does not match the others.
    """
    points = results.model.points
    return ReportData(
        scene=results.scene,
        metrics=results.metrics,
        plan=results.plan,
        decisions=_decisions(results.plan, results.folders["inspect"].parent),
        curve=_curve(results.folders["train"]),
        comparisons=_comparisons(results, evaluation, shown),
        trained=TrainedScene(
            gaussians=results.gaussians,
            views=results.views,
            orientations={photo.name: photo.orientation for photo in results.manifest.photos},
            background=results.protocol.background,
            antialias=results.antialias,
            near=results.protocol.near,
            normalization=Georeference.normalization_of(results.folders["poses"]),
        ),
        coverage=_coverage(results.folders["coverage"]),
        blocks=_blocks(results.plan, results.folders["inspect"].parent),
        points_xyz=points.xyz,
        points_rgb=points.rgb,
        reprojection_errors=points.error[points.error >= 0],
        track_lengths=points.track_length,
    )


def _comparisons(results: SceneResults, evaluation: Evaluation, shown: int) -> list[Comparison]:
    """The views to show, worst to best, each beside its photograph."""
    photos = {photo.name: photo for photo in results.manifest.photos}
    by_name = {view.name: view for view in results.views}
    comparisons = []
    for label, measured in ranked(evaluation.per_view, shown):
        view = by_name[measured.name]
        pixels = load_view(view)
        with Image.open(results.folders["evaluate"] / "renders" / measured.render) as render:
            comparisons.append(
                Comparison(
                    label=label,
                    name=view.name,
                    photograph=pixels.over(results.protocol.background),
                    render=np.asarray(render),
                    mask=pixels.mask,
                    psnr=measured.psnr,
                    ssim=measured.ssim,
                    orientation=photos[view.name].orientation,
                )
            )
    return comparisons


def _coverage(folder: Path) -> CoverageSection:
    record = CoverageRecord.read(folder)
    pictures = {}
    shown: list[ViewCoverage | ProposedViewpoint] = [*record.views, *record.viewpoints]
    for entry in shown:
        for name in filter(None, (entry.render, entry.trust_map)):
            with Image.open(folder / name) as picture:
                pictures[name] = np.asarray(picture)
    return CoverageSection(record, pictures)


def _blocks(plan: PlanRecord, results: Path) -> BlocksSection | None:
    """The blocks of the scene; None if it was trained as one."""
    if not plan.runs("partition"):
        return None
    runs = []
    for number in range(1, plan.stages["polish"].jobs + 1):
        folders = [results / f"{stage}_{number}" for stage in ("block", "polish")]
        run = together([read_run(folder) for folder in folders])
        counters = read_counters(folders[-1], TrainCounters)
        last = TrainingCurve.read(folders[-1]).root[-1]
        runs.append(
            BlockRun(counters.num_gaussians, last.psnr, run.wall_s + run.earlier_s, run.peak_rss_mb)
        )
    return BlocksSection(Partition.read(results / "partition"), runs)


def _curve(folder: Path) -> list[TrainingRecord]:
    """The training curve with the times of the run that recorded it."""
    seconds = read_run(folder).curve_seconds or []
    curve = TrainingCurve.read(folder).root
    if len(seconds) != len(curve):
        raise mismatch(
            folder / TrainingCurve.file_name,
            f"expected a record for each of the {len(seconds)} times in run.json, found "
            f"{len(curve)} records",
        )
    return [TrainingRecord(*pair) for pair in zip(curve, seconds, strict=True)]


def _decisions(plan: PlanRecord, results: Path) -> dict[str, list[str]]:
    """The decisions of each stage that ran: those of the plan, then those of the stage."""
    return {
        name: step.decisions
        + [
            text
            for job in step.folders(name)
            if name != "report"
            for text in read_stage(results / job).decisions
        ]
        for name, step in plan.stages.items()
        if step.run
    }
