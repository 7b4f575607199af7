"""Reads the results of a scene from the outputs of its stages."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.coverage.record import CoverageRecord, ProposedViewpoint, ViewCoverage
from pipeline.holes.record import HolesRecord
from pipeline.metrics.evaluation import ViewMetrics
from pipeline.photos.load import load_view
from pipeline.plan.record import PlanRecord
from pipeline.reporting.data import (
    BlockRun,
    BlocksSection,
    Comparison,
    CoverageSection,
    HolesSection,
    Rank,
    SceneResults,
    TrainedScene,
    TrainingRecord,
    ranked,
)
from pipeline.reporting.metrics import TimedMetrics, together
from pipeline.reporting.names import photograph_names
from pipeline.reporting.publish import downloads
from pipeline.runtime.counters import read_counters
from pipeline.runtime.json_file import mismatch
from pipeline.runtime.record import read_run, read_stage
from pipeline.scene.blocks import Partition
from pipeline.scene.manifest import Manifest
from pipeline.scene.reconstruction import Points
from pipeline.training.loop.counters import TrainCounters
from pipeline.training.loop.curve import TrainingCurve


def read_results(
    folders: Mapping[str, Path],
    metrics: TimedMetrics,
    plan: PlanRecord,
    trained: TrainedScene,
    points: Points,
    shown: int,
) -> SceneResults:
    """Read the results of a scene.

    Args:
        folders: The folders of inspect, train, evaluate, coverage and export, and of holes if it
            ran, by stage.
        metrics: The content of ``metrics.json`` with the times of the stages.
        plan: The plan of the scene.
        trained: The Gaussians and their views.
        points: The sparse points, world.
        shown: The number of views shown with their photographs.

    Raises:
        UserError: An output of a stage is missing, damaged, or does not match the others.
    """
    scene = folders["inspect"].parent
    return SceneResults(
        metrics=metrics,
        plan=plan,
        trained=trained,
        points=points,
        coverage=_coverage(folders["coverage"]),
        decisions=_decisions(plan, scene),
        curve=_curve(folders["train"]),
        comparisons=[
            _comparison(label, measured, trained, folders["evaluate"] / "renders")
            for label, measured in ranked(metrics.per_view, shown)
        ],
        blocks=_blocks(plan, scene),
        holes=_holes(folders.get("holes")),
        photographs=photograph_names(
            [view.name for view in trained.views],
            [photo.name for photo in Manifest.read(folders["inspect"] / "images.json").photos],
        ),
        downloads=downloads(folders["export"]),
    )


def _comparison(
    label: Rank, measured: ViewMetrics, trained: TrainedScene, renders: Path
) -> Comparison:
    """A measured view beside its photograph."""
    view = next(view for view in trained.views if view.name == measured.name)
    pixels = load_view(view)
    with Image.open(renders / measured.render) as render:
        return Comparison(
            label=label,
            name=view.name,
            photograph=pixels.over(trained.background),
            render=np.asarray(render),
            mask=pixels.mask,
            psnr=measured.psnr,
            ssim=measured.ssim,
            orientation=trained.orientations[view.name],
        )


def _coverage(folder: Path) -> CoverageSection:
    record = CoverageRecord.read(folder)
    pictures = {}
    shown: list[ViewCoverage | ProposedViewpoint] = [*record.views, *record.viewpoints]
    names = [name for entry in shown for name in (entry.render, entry.trust_map)]
    if record.novel_views is not None:
        names += [record.novel_views.worst.render, record.novel_views.worst.map]
    for name in filter(None, names):
        with Image.open(folder / name) as picture:
            pictures[name] = np.asarray(picture)
    return CoverageSection(record, pictures)


def _holes(folder: Path | None) -> HolesSection | None:
    """What was invented, with the pictures of the views that are shown."""
    if folder is None:
        return None
    record, shown = HolesRecord.read(folder), []
    for view in record.painted:
        files = [file for file in (view.before, view.mask, view.after) if file is not None]
        pictures = []
        for file in files:
            with Image.open(folder / file) as picture:
                pictures.append(np.asarray(picture))
        if pictures:
            shown.append(pictures)
    return HolesSection(record, shown)


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
