"""Results of a batch of runs: rows, means over seeds and scenes, and published figures."""

from __future__ import annotations

import csv
import io
import json
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pipeline.config.runs import Run
from pipeline.plan.protocols import benchmark_scene
from pipeline.reporting.metrics import TimedMetrics

PUBLISHED = Path(__file__).with_name("published.json")

# Fields of a run that are averaged over seeds and scenes.
MEASURES = (
    "psnr",
    "ssim",
    "lpips",
    "train_psnr",
    "num_gaussians",
    "size_mb",
    "rotation_error_deg",
    "centre_error_share",
    "wall_s",
    "cpu_s",
    "peak_rss_mb",
)
_TIMES = ("wall_s", "cpu_s", "peak_rss_mb")
# Fields of ``run.json`` that describe the machine and code of a timing.
MACHINE = ("host", "processor", "cores", "threads", "load_average", "commit")


@dataclass(frozen=True)
class Result:
    """Outcome of one run of a batch.

    Attributes:
        run: The run.
        status: "left out": the folder is no scene; "not run": the run was not started.
        stage: The name of the failed stage; empty otherwise.
        message: The reason, if the status is not "ok".
        metrics: The content of ``metrics.json`` with times; None unless status is "ok".
        size_mb: The size of the exported Gaussians (PLY) in MB (10^6 bytes), or None.
        machine: The fields ``MACHINE`` of its training.
    """

    run: Run
    status: Literal["ok", "failed", "not run", "left out"]
    stage: str = ""
    message: str = ""
    metrics: TimedMetrics | None = None
    size_mb: float | None = None
    machine: Mapping[str, Any] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        return self.status == "ok"


@dataclass(frozen=True)
class Spread:
    """Mean, minimum, maximum and number of values of a measure over seeds or scenes."""

    mean: float
    low: float
    high: float
    count: int


def row(result: Result, stages: Sequence[str] = ()) -> dict[str, Any]:
    """One line of ``benchmark.csv``: the run, its status, quality, and the time and memory of
    each of ``stages`` (empty if skipped). Names contain the units."""
    m = {} if result.metrics is None else result.metrics.model_dump(mode="json")
    protocol = m.get("protocol") or {}
    pose = m.get("pose_error") or {}
    ran = {name: s for name, s in (m.get("stages") or {}).items() if not s["skipped"]}
    line: dict[str, Any] = {
        "scene": result.run.scene,
        "config": result.run.config,
        "seed": m.get("seed", result.run.seed),
        "status": result.status,
        "failed_stage": result.stage,
        "message": "; ".join(line.strip() for line in result.message.splitlines()),
        "psnr": m.get("psnr"),
        "ssim": m.get("ssim"),
        "lpips": m.get("lpips"),
        "train_psnr": m.get("train_psnr"),
        "views": protocol.get("num_views"),
        "resolution": " ".join(protocol.get("resolution") or []),
        "num_gaussians": m.get("num_gaussians"),
        "size_mb": result.size_mb,
        "registered_images": m.get("registered_images"),
        "total_images": m.get("total_images"),
        "reprojection_error_px": m.get("reprojection_error_px"),
        "rotation_error_deg": pose.get("rotation_median_deg"),
        "centre_error_share": pose.get("centre_relative_median"),
        "wall_s": _sum(s["wall_s"] for s in ran.values()),
        "cpu_s": _sum(s["cpu_s"] for s in ran.values()),
        "peak_rss_mb": max((s["peak_rss_mb"] for s in ran.values()), default=None),
        "warnings": len(m["warnings"]) if result.ok else None,
    }
    for stage in stages:
        for fact in _TIMES:
            line[f"{stage}_{fact}"] = ran[stage][fact] if stage in ran else None
    return line | {name: result.machine.get(name) for name in MACHINE}


def _sum(values: Iterable[float | None]) -> float | None:
    """The sum; None without values, or if one is not known."""
    found = list(values)
    known = [value for value in found if value is not None]
    return round(sum(known), 3) if known and len(known) == len(found) else None


def as_csv(results: Sequence[Result], stages: Sequence[str] = ()) -> str:
    """``benchmark.csv``: a header and one line per run, with columns for these stages."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(row(results[0], stages)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(row(result, stages) for result in results)
    return text.getvalue()


def as_json(results: Sequence[Result], stages: Sequence[str] = ()) -> dict[str, Any]:
    """``benchmark.json``: the rows, the means over seeds by scene and configuration, the means
    over the scenes that every configuration finished, and published figures."""
    means = {
        scene: {config: _plain(spreads) for config, spreads in by_config.items()}
        for scene, by_config in by_scene(results).items()
    }
    scenes, over = by_config(results)
    return {
        "runs": [row(result, stages) for result in results],
        "scenes": means,
        "configs": {config: _plain(spreads) for config, spreads in over.items()},
        "configs_over_scenes": scenes,
        "published": {
            scene: published
            for scene in means
            if (published := published_for(scene, photographs(results, scene)))
        },
    }


def _plain(spreads: Mapping[str, Spread]) -> dict[str, Any]:
    return {name: vars(spread) for name, spread in spreads.items()}


def by_scene(results: Sequence[Result]) -> dict[str, dict[str, dict[str, Spread]]]:
    """Scene -> configuration -> measure -> its spread over the seeds that finished."""
    found: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for result in results:
        if result.ok:
            of_scene = found.setdefault(result.run.scene, {})
            of_scene.setdefault(result.run.config, []).append(row(result))
    return {
        scene: {config: _spreads(rows) for config, rows in of_scene.items()}
        for scene, of_scene in found.items()
    }


def by_config(results: Sequence[Result]) -> tuple[list[str], dict[str, dict[str, Spread]]]:
    """The scenes that every configuration finished (configurations without a finished scene are
    ignored), and configuration -> measure -> its spread over these scenes.
    """
    configs = list(dict.fromkeys(result.run.config for result in results if result.ok))
    means = by_scene(results)
    scenes = [scene for scene, of_scene in means.items() if len(of_scene) == len(configs)]
    over = {
        config: _spreads(
            [{name: s.mean for name, s in means[scene][config].items()} for scene in scenes]
        )
        for config in configs
        if scenes
    }
    return scenes, over


def _spreads(rows: Sequence[Mapping[str, Any]]) -> dict[str, Spread]:
    """The spread of each measure that all rows contain."""
    spreads = {}
    for name in MEASURES:
        values = [line[name] for line in rows if line.get(name) is not None]
        if values and len(values) == len(rows):
            spreads[name] = Spread(statistics.fmean(values), min(values), max(values), len(values))
    return spreads


def photographs(results: Sequence[Result], scene: str) -> int | None:
    """The number of photographs of a scene; None without a finished run."""
    found = (r.metrics.total_images for r in results if r.metrics and r.run.scene == scene)
    return next(found, None)


def published_for(scene: str, count: int | None) -> list[dict[str, Any]]:
    """Published figures for a scene, by the name of its folder and its number of photographs.

    Returns:
        One dict per method: ``method``, ``dataset``, ``source``, ``protocol``, ``differs`` (how
        from the protocol of the data set; None if not at all) and its measures.
    """
    data = json.loads(PUBLISHED.read_text())
    name = benchmark_scene(scene)
    return [
        {key: entry[key] for key in ("method", "dataset", "source", "protocol", "differs")}
        | entry["scenes"][name]
        for entry in data["results"]
        if name in entry["scenes"] and count in data["photographs"][entry["dataset"]][name]
    ]
