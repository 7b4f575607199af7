"""``metrics.json`` and one page with everything: ``report.html``, which opens without a network."""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline.config.schema import Report, Split, Train, Views
from pipeline.metrics.evaluate import choose_protocol, reference
from pipeline.photos.load import load_view
from pipeline.reporting.collect import collect_metrics
from pipeline.reporting.data import Comparison, Coverage, ReportData, TrainedScene, ranked
from pipeline.reporting.headline import headline
from pipeline.reporting.page import write_report
from pipeline.runtime.atomic import write_json
from pipeline.runtime.job import Job, read_stage, run_facts
from pipeline.scene.manifest import Manifest
from pipeline.scene.model import Reconstruction, View
from pipeline.scene.views import load_views
from pipeline.splats.gaussians import Gaussians
from stages.command import main
from stages.models import trained_model


def run(job: Job) -> None:
    start = time.perf_counter()
    plan = job.key["plan"]
    manifest = Manifest.read(job.inputs["views"] / "images.json")
    model = trained_model(job)
    views = load_views(manifest, model, job.section(Views), job.section(Split))
    evaluation = read_json(job.inputs["evaluate"] / "evaluation.json")
    protocol = choose_protocol(views, job.section(Split), job.section(Train))
    comparisons = compare(job, manifest, views, evaluation, protocol.background)
    own = run_facts(job, time.perf_counter() - start)
    results = job.inputs["inspect"].parent
    metrics = collect_metrics(job.scene, plan, results, evaluation, own)
    write_json(job.out / "metrics.json", metrics)
    data = ReportData(
        scene=job.scene,
        metrics=metrics,
        plan=plan,
        decisions=stage_decisions(plan, results),
        curve=curve_of(job.inputs["train"]),
        comparisons=comparisons,
        trained=TrainedScene(
            gaussians=Gaussians.load(job.inputs["train"] / "gaussians.npz"),
            views=views,
            orientations={photo.name: photo.orientation for photo in manifest.photos},
            background=protocol.background,
            antialias=job.section(Train).antialias,
            near=protocol.near,
        ),
        coverage=coverage_of(job.inputs["evaluate"]),
        **points_of(model),
    )
    write_report(data, job.out / "report.html")
    job.decide(headline(metrics))


def compare(
    job: Job,
    manifest: Manifest,
    views: list[View],
    evaluation: dict[str, Any],
    background: tuple[float, float, float],
) -> list[Comparison]:
    """The views to show, worst to best, each beside its photograph."""
    photos = {photo.name: photo for photo in manifest.photos}
    by_name = {view.name: view for view in views}
    shown = []
    for label, measured in ranked(evaluation["per_view"], job.section(Report).views):
        view = by_name[measured["name"]]
        pixels = load_view(view.image, view.mask, view.width, view.height)
        with Image.open(job.inputs["evaluate"] / "renders" / measured["render"]) as render:
            shown.append(
                Comparison(
                    label=label,
                    name=view.name,
                    photograph=reference(pixels, background),
                    render=np.asarray(render),
                    mask=pixels.mask,
                    psnr=measured["psnr"],
                    ssim=measured["ssim"],
                    orientation=photos[view.name].orientation,
                )
            )
    return shown


def coverage_of(evaluate: Path) -> Coverage:
    """What the photographs did not see, with the pictures of it."""
    record = read_json(evaluate / "coverage.json")
    pictures = {}
    for shown in (*record.get("views", ()), *record.get("viewpoints", ())):
        for name in (shown[key] for key in ("render", "trust_map") if key in shown):
            with Image.open(evaluate / name) as picture:
                pictures[name] = np.asarray(picture)
    return Coverage(record, pictures)


def curve_of(train: Path) -> list[dict[str, Any]]:
    """The training curve with the seconds of the run that made it."""
    seconds = read_json(train / "run.json")["curve_seconds"]
    records = read_json(train / "curve.json")
    return [r | {"seconds": s} for r, s in zip(records, seconds, strict=True)]


def points_of(model: Reconstruction) -> dict[str, Any]:
    return {
        "points_xyz": model.points.xyz,
        "points_rgb": model.points.rgb,
        "reprojection_errors": model.points.error[model.points.error >= 0],
        "track_lengths": model.points.track_length,
    }


def stage_decisions(plan: dict[str, Any], results: Path) -> dict[str, list[str]]:
    """What each stage that has run decided, beside what the plan decided for it."""
    return {
        name: step["decisions"]
        + (read_stage(results / name)["decisions"] if name != "report" else [])
        for name, step in plan["stages"].items()
        if step["run"]
    }


def read_json(path: Path) -> Any:
    return json.loads(path.read_text())


if __name__ == "__main__":
    main("report", run, __doc__)
