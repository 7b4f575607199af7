"""The page of a batch: every scene under every configuration, next to what others published.

As the page of a scene, one file that opens without a network; it links to those beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from pipeline.plan.record import PlanRecord
from pipeline.reporting.batch import (
    Result,
    Spread,
    by_config,
    by_scene,
    photographs,
    published_for,
    row,
)
from pipeline.reporting.charts import ChartPoint, trade_off_chart
from pipeline.reporting.dag import plan_svg
from pipeline.reporting.html import Section, render
from pipeline.reporting.metrics import TimedMetrics
from pipeline.reporting.pictures import embedded, shrunk, upright
from pipeline.reporting.text import count, duration, fixed
from pipeline.reporting.verdict import TITLES, Grade, grade_of, worst

_THUMBNAIL_PX = 240
_THUMBNAIL_QUALITY = 84

# Measures of the tables: name -> (heading, decimals).
_MEASURES = {
    "psnr": ("PSNR, dB", 2),
    "ssim": ("SSIM", 4),
    "lpips": ("LPIPS", 3),
    "num_gaussians": ("Gaussians", 0),
    "size_mb": ("PLY, MB", 1),
    "rotation_error_deg": ("Rotation error, \u00b0", 3),
}
_HEADINGS = {name: heading for name, (heading, _) in _MEASURES.items()} | {
    "wall_s": "Time",
    "cpu_s": "CPU",
    "peak_rss_mb": "Memory",
}


@dataclass(frozen=True)
class Thumbnail:
    """A small picture: a data URI, its size in pixels and the name of the view."""

    uri: str
    width: int
    height: int
    view: str


def thumbnail(picture: NDArray[np.uint8], orientation: int, view: str) -> Thumbnail:
    """A small JPEG of an (H, W, 3) picture, rotated by its EXIF orientation."""
    small = shrunk(upright(picture, orientation), _THUMBNAIL_PX)
    return Thumbnail(*embedded(small, _THUMBNAIL_QUALITY), view)


@dataclass(frozen=True)
class Batch:
    """Content of the page of a batch.

    Attributes:
        results: One per run, ordered by scene; at least one.
        renders: The render of a test view by the run's name.
        photos: The photograph of that view by scene.
        plans: The plan of a scene's first run, by scene.
        stages: The names of the stages in the order of the DAG.
    """

    results: Sequence[Result]
    renders: Mapping[str, Thumbnail] = field(default_factory=dict)
    photos: Mapping[str, Thumbnail] = field(default_factory=dict)
    plans: Mapping[str, PlanRecord] = field(default_factory=dict)
    stages: Sequence[str] = ()


Cells = Mapping[str, tuple[str, str]]


class TableRow(NamedTuple):
    """A line of a table.

    Attributes:
        label: What was measured.
        cells: For each measure the value, and half its range or nothing.
        pages: The names of runs, and the texts of the links to their pages.
        deviations: How the runs deviate from the published protocol; None for no remark.
        published: Whether these are the figures of others.
        verdict: The worst verdict on the runs, and its title; None for means over scenes.
    """

    label: str
    cells: Cells
    pages: Mapping[str, str] = {}
    deviations: str | None = None
    published: bool = False
    verdict: tuple[Grade, str] | None = None


class SceneContent(NamedTuple):
    """What the section of a scene shows.

    Attributes:
        first: The metrics of the first finished run.
        sizes: The sizes of the measured views.
        pictures: Pictures with their captions and the runs that they link to.
        rows, headings: The table.
        chart: Error against time, of several configurations.
        plan: The diagram of the plan.
    """

    first: TimedMetrics
    sizes: Sequence[str]
    pictures: Sequence[tuple[Thumbnail, str, str]]
    rows: Sequence[TableRow]
    headings: Mapping[str, str]
    chart: Markup | None
    plan: Markup | None


def index_html(batch: Batch) -> str:
    """The page as a string; the same batch gives the same bytes."""
    results = batch.results
    scenes = list(by_scene(results))
    sections = []
    if scenes:
        used = [
            name
            for name in batch.stages
            if any(name in m.stages and not m.stages[name].skipped for _, m in _finished(results))
        ]
        done = [result for result in results if result.ok]
        timed = {"stages": used, "results": done}
        folder = "batch/{}.html.jinja".format
        means = _configurations(results)
        sections = [
            Section("means", "Configurations", folder("configurations"), means),
            *(
                Section(f"scene-{i}", scene, folder("scene"), _scene(batch, scene))
                for i, scene in enumerate(scenes)
            ),
            Section("stages", "Time and memory", folder("stages"), timed),
        ]
        if sources := _sources(results, scenes):
            title = "Published numbers"
            sections.append(Section("published", title, folder("published"), sources))
    return render(
        "batch/page.html.jinja",
        num_scenes=len(scenes),
        lead=_lead(results),
        failed=[result for result in results if not result.ok],
        sections=sections,
    )


def _finished(results: Sequence[Result]) -> list[tuple[Result, TimedMetrics]]:
    return [(result, result.metrics) for result in results if result.metrics is not None]


def _label(config: str) -> str:
    return config or "as configured"


def _lead(results: Sequence[Result]) -> list[str]:
    seeds = sorted({r.run.seed for r in results if r.run.seed is not None})
    machines = dict.fromkeys(
        f"{r.machine['host']} ({r.machine['processor'] or 'unknown processor'}) with "
        f"{r.machine['threads']} threads"
        for r in results
        if r.machine
    )
    parts = [f"{sum(r.ok for r in results)} of {len(results)} runs finished"]
    if seeds:
        parts.append(f"seeds {', '.join(map(str, seeds))}")
    if machines:
        parts.append(f"on {', '.join(machines)}")
    return parts


# --- configurations -----------------------------------------------------------------------


def _configurations(results: Sequence[Result]) -> dict[str, Any]:
    """The means over scenes, as a table and as charts."""
    scenes, over = by_config(results)
    sizes: dict[str, set[Any]] = {}
    for result, metrics in _finished(results):
        if result.run.scene in scenes:
            sizes.setdefault(result.run.scene, set()).add(metrics.protocol.resolution)
    rows = []
    for config, spreads in over.items():
        # No ranges: over scenes, they describe the scenes rather than the configuration.
        means = {name: Spread(s.mean, s.mean, s.mean, 1) for name, s in spreads.items()}
        rows.append(TableRow(_label(config), _cells(means)))
    return {
        "scenes": scenes,
        "sizes_differ": any(len(found) > 1 for found in sizes.values()),
        "rows": rows,
        "headings": _headings(rows),
        "charts": _means_charts(results, over) if scenes else [],
    }


def _means_charts(
    results: Sequence[Result], over: Mapping[str, Mapping[str, Spread]]
) -> list[Markup]:
    colours = {config: i for i, config in enumerate(over)}
    single = len(over) == 1
    charts = []
    for measure, (title, label) in _ERRORS.items():
        points = []
        for r in results:
            line = row(r)
            if r.ok and line[measure] is not None:
                name = r.run.scene if single else ""
                points.append(_chart_point(line, measure, name, r.run.name, colours[r.run.config]))
        if not single:
            for config, spreads in over.items():
                if measure in spreads:
                    values = {name: s.mean for name, s in spreads.items()}
                    points.append(_chart_point(values, measure, config, config, colours[config]))
        if points:
            charts.append(trade_off_chart(points, title=title, x_title="time", y_label=label))
    return charts


# Measure -> title and format of the chart of its error.
_ERRORS: dict[str, tuple[str, Callable[[float], str]]] = {
    "psnr": ("Pixel error against time", lambda value: f"{value:.3g} %"),
    "ssim": ("1 - SSIM against time", lambda value: f"{value:.2g}"),
    "lpips": ("LPIPS against time", lambda value: f"{value:.2g}"),
}


def _error(measure: str, value: float) -> float:
    """The error that a measure corresponds to; positive, for a logarithmic axis."""
    if measure == "psnr":
        return 100 * 10 ** (-value / 20)
    return max(1 - value if measure == "ssim" else value, 1e-6)


def _chart_point(
    values: Mapping[str, Any], measure: str, name: str, tip: str, colour: int
) -> ChartPoint:
    shown = f"{tip}: {fixed(values[measure], 3)} {measure.upper()}, {duration(values['wall_s'])}"
    return ChartPoint(
        max(values["wall_s"], 1e-3), _error(measure, values[measure]), name, shown, colour
    )


# --- one scene ----------------------------------------------------------------------------


def _scene(batch: Batch, scene: str) -> SceneContent:
    results = [r for r in batch.results if r.run.scene == scene]
    done = _finished(results)
    means = by_scene(results)[scene]
    published = published_for(scene, photographs(results, scene))
    rows = []
    for config, spreads in means.items():
        runs = [(r, metrics) for r, metrics in done if r.run.config == config]
        pages = {r.run.name: f"seed {metrics.seed}" for r, metrics in runs}
        deviations = _deviations([metrics for _, metrics in runs]) if published else None
        grade = worst([grade_of(metrics) for _, metrics in runs])
        told = grade, TITLES[grade]
        rows.append(TableRow(_label(config), _cells(spreads), pages, deviations, verdict=told))
    for entry in published:
        cells = {
            name: (fixed(entry[name], min(digits, 3)), "")
            for name, (_, digits) in _MEASURES.items()
            if name in entry
        }
        rows.append(TableRow(f"{entry['method']} (published)", cells, published=True))
    chart = None
    if len(means) > 1:
        points = [
            _chart_point({n: s.mean for n, s in spreads.items()}, "psnr", _label(config), config, i)
            for i, (config, spreads) in enumerate(means.items())
        ]
        title, label = _ERRORS["psnr"]
        chart = trade_off_chart(points, title=title, x_title="time", y_label=label)
    plan = batch.plans.get(scene)
    return SceneContent(
        first=done[0][1],
        sizes=list(dict.fromkeys(size for _, m in done for size in m.protocol.resolution)),
        pictures=_pictures(batch, scene, done),
        rows=rows,
        headings=_headings(rows),
        chart=chart,
        plan=plan_svg(plan) if plan else None,
    )


def _deviations(runs: Sequence[TimedMetrics]) -> str | None:
    """How these runs deviate from the published protocol; None if all were measured by it."""
    found = [metrics.protocol.published for metrics in runs]
    if all(published and not published.deviations for published in found):
        return None
    return "; ".join(dict.fromkeys(text for p in found if p for text in p.deviations))


def _pictures(
    batch: Batch, scene: str, done: Sequence[tuple[Result, TimedMetrics]]
) -> list[tuple[Thumbnail, str, str]]:
    """The photograph of a view, then the render of each configuration's first run."""
    pictures = []
    if photo := batch.photos.get(scene):
        pictures.append((photo, f"photograph {photo.view}", ""))
    shown: set[str] = set()
    for result, metrics in done:
        run = result.run
        if run.config not in shown and run.name in batch.renders:
            caption = f"{_label(run.config)}, {fixed(metrics.psnr, 2)} dB"
            pictures.append((batch.renders[run.name], caption, run.name))
        shown.add(run.config)
    return pictures


# --- tables -------------------------------------------------------------------------------


def _cells(spreads: Mapping[str, Spread]) -> dict[str, tuple[str, str]]:
    """One cell per measure: its mean and, over several seeds or scenes, half of its range."""
    cells = {}
    for name, (_, digits) in _MEASURES.items():
        if name in spreads:
            s = spreads[name]
            off = fixed((s.high - s.low) / 2, digits) if s.count > 1 else ""
            cells[name] = fixed(s.mean, digits), off
    for name in ("wall_s", "cpu_s"):
        if name in spreads:
            cells[name] = duration(spreads[name].mean), ""
    if "peak_rss_mb" in spreads:
        cells["peak_rss_mb"] = f"{count(spreads['peak_rss_mb'].mean)} MB", ""
    return cells


def _headings(rows: Sequence[TableRow]) -> dict[str, str]:
    """The columns that at least one row has."""
    return {
        name: heading
        for name, heading in _HEADINGS.items()
        if any(name in line.cells for line in rows)
    }


def _sources(results: Sequence[Result], scenes: Sequence[str]) -> list[dict[str, Any]]:
    """Source and protocol of every published number on the page."""
    shown = {
        (entry["method"], entry["dataset"]): entry
        for scene in scenes
        for entry in published_for(scene, photographs(results, scene))
    }
    return list(shown.values())
