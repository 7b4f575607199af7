"""The tables of a batch of runs: ``benchmark.csv``, ``benchmark.json``, and their page."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline.config.runs import Run
from pipeline.photos.load import ViewPixels, load_rgba, resize_rgba
from pipeline.plan.record import PlanRecord, read_plan
from pipeline.reporting.batch import MACHINE, Result, as_csv, as_json
from pipeline.reporting.data import ranked
from pipeline.reporting.index import Batch, Thumbnail, index_html, thumbnail
from pipeline.reporting.metrics import read_metrics, read_runs, with_times
from pipeline.runtime.atomic import write_json, write_text
from pipeline.runtime.record import read_run
from pipeline.scene.manifest import Manifest
from stages.workflow.failures import reporting_errors
from stages.workflow.registry import STAGES


def write_batch(outcomes: list[dict[str, Any]], results: Path) -> None:
    """Write the three files into the folder ``results``.

    Args:
        outcomes: A record of each run with ``run`` (scene, config, seed) and ``status``. Unless
            that is "ok", it also has ``stage`` and ``message`` (see
            ``pipeline.reporting.batch.Result``).
        results: The folder of the runs.
    """
    found = [result_of(outcome, results) for outcome in outcomes]
    write_text(results / "benchmark.csv", as_csv(found, list(STAGES)))
    write_json(results / "benchmark.json", as_json(found, list(STAGES)))
    write_text(results / "index.html", index_html(batch_of(found, results)))


def result_of(outcome: dict[str, Any], results: Path) -> Result:
    """A run's outcome with the measurements in its folder."""
    run = Run(*outcome["run"])
    if outcome["status"] != "ok":
        return Result(run, outcome["status"], outcome["stage"], outcome["message"])
    folder = results / run.name
    ply = folder / "export" / "point_cloud.ply"
    metrics = read_metrics(folder)
    facts = read_run(folder / "train").model_dump(mode="json")
    return Result(
        run,
        "ok",
        metrics=with_times(metrics, read_runs(metrics, folder)),
        size_mb=round(ply.stat().st_size / 1e6, 3) if ply.is_file() else None,
        machine={name: facts.get(name) for name in MACHINE},
    )


def batch_of(found: list[Result], results: Path) -> Batch:
    """The page's content. All images of a scene show the same view: the first run's median."""
    renders: dict[str, Thumbnail] = {}
    photos: dict[str, Thumbnail] = {}
    plans: dict[str, PlanRecord] = {}
    views: dict[str, str] = {}
    for result in (r for r in found if r.ok):
        scene, folder = result.run.scene, results / result.run.name
        metrics = read_metrics(folder)
        plan = plans.setdefault(scene, read_plan(folder))
        name = views.setdefault(scene, ranked(metrics.per_view, 1)[0][1].name)
        measured = next((v for v in metrics.per_view if v.name == name), metrics.per_view[0])
        source = next((s for s in ("undistort", "decode") if plan.runs(s)), "inspect")
        manifest = Manifest.read(folder / source / "images.json")
        photo = next(p for p in manifest.photos if p.name == measured.name)
        with Image.open(folder / "evaluate" / "renders" / measured.render) as opened:
            render = np.asarray(opened.convert("RGB"))
        renders[result.run.name] = thumbnail(render, photo.orientation, name)
        if scene not in photos:
            height, width = render.shape[:2]
            rgb, alpha = load_rgba(photo.path, photo.digest)
            pixels = ViewPixels(*resize_rgba(rgb, alpha, width, height), None)
            photograph = pixels.over(metrics.protocol.background)
            photos[scene] = thumbnail(photograph, photo.orientation, name)
    return Batch(found, renders, photos, plans, list(STAGES))


if __name__ == "__main__":
    parser = argparse.ArgumentParser("stages.workflow.batch", description=__doc__)
    parser.add_argument("--results", type=Path, required=True, help="the folder of the runs")
    parser.add_argument("--outcomes", required=True, help="how each run ended (JSON), or - (stdin)")
    args = parser.parse_args()
    text = sys.stdin.read() if args.outcomes == "-" else args.outcomes
    with reporting_errors("the batch's tables"):
        write_batch(json.loads(text)["outcomes"], args.results)
