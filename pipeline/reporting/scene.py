"""Reads the content of a scene's page from the outputs of its stages."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline.metrics.evaluate import Protocol, photo_over_background
from pipeline.photos.load import load_view
from pipeline.plan.record import PlanRecord
from pipeline.reporting.data import Comparison, Coverage, ReportData, TrainedScene, ranked
from pipeline.runtime.record import read_run, read_stage
from pipeline.scene.manifest import Manifest
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians


@dataclass(frozen=True)
class SceneResults:
    """Outputs of the stages of a scene.

    Attributes:
        metrics: the content of ``metrics.json`` with the times of the stages.
        folders: role -> the stage's folder: inspect, train, evaluate and coverage.
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
    gaussians: Gaussians
    protocol: Protocol
    antialias: bool


def report_data(results: SceneResults, evaluation: Mapping[str, Any], shown: int) -> ReportData:
    """The content of the page.

    Args:
        evaluation: the content of ``evaluation.json``.
        shown: number of views shown with their photographs.
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
        ),
        coverage=_coverage(results.folders["coverage"]),
        points_xyz=points.xyz,
        points_rgb=points.rgb,
        reprojection_errors=points.error[points.error >= 0],
        track_lengths=points.track_length,
    )


def _comparisons(
    results: SceneResults, evaluation: Mapping[str, Any], shown: int
) -> list[Comparison]:
    """The views to show, worst to best, each beside its photograph."""
    photos = {photo.name: photo for photo in results.manifest.photos}
    by_name = {view.name: view for view in results.views}
    comparisons = []
    for label, measured in ranked(evaluation["per_view"], shown):
        view = by_name[measured["name"]]
        pixels = load_view(view)
        with Image.open(results.folders["evaluate"] / "renders" / measured["render"]) as render:
            comparisons.append(
                Comparison(
                    label=label,
                    name=view.name,
                    photograph=photo_over_background(pixels, results.protocol.background),
                    render=np.asarray(render),
                    mask=pixels.mask,
                    psnr=measured["psnr"],
                    ssim=measured["ssim"],
                    orientation=photos[view.name].orientation,
                )
            )
    return comparisons


def _coverage(folder: Path) -> Coverage:
    record = read_json(folder / "coverage.json")
    pictures = {}
    for shown in (*record.get("views", ()), *record.get("viewpoints", ())):
        for name in (shown[key] for key in ("render", "trust_map") if key in shown):
            with Image.open(folder / name) as picture:
                pictures[name] = np.asarray(picture)
    return Coverage(record, pictures)


def _curve(train: Path) -> list[dict[str, Any]]:
    """The training curve with the times of the run that recorded it."""
    seconds = read_run(train).curve_seconds or []
    records = read_json(train / "curve.json")
    return [r | {"seconds": s} for r, s in zip(records, seconds, strict=True)]


def _decisions(plan: PlanRecord, results: Path) -> dict[str, list[str]]:
    """The decisions of each stage that ran: those of the plan, then those of the stage."""
    return {
        name: step.decisions
        + (list(read_stage(results / name).decisions) if name != "report" else [])
        for name, step in plan.stages.items()
        if step.run
    }


def read_json(path: Path) -> Any:
    return json.loads(path.read_text())
