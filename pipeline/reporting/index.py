"""The page of a batch: every scene under every configuration, next to what others published.

As the page of a scene, one file that opens without a network; it links to those beside it.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray
from PIL import Image

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
from pipeline.reporting.pictures import shrunk, upright
from pipeline.reporting.style import CSS
from pipeline.reporting.text import MISSING, count, duration, escape, fixed

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"

_CSS = """
a { color: var(--accent); }
.thumbs { display: flex; flex-wrap: wrap; gap: 12px; margin: 12px 0 16px; }
.thumbs figure { margin: 0; font-size: 12.5px; color: var(--soft); max-width: 240px; }
.thumbs img { display: block; max-width: 100%; height: auto; border-radius: 9px; }
.published td { color: var(--soft); font-style: italic; }
.failed td:first-child { color: var(--bad); font-weight: 600; }
.front { fill: none; stroke: var(--soft); stroke-dasharray: 4 3; }
.charts.single { max-width: 520px; margin-top: 14px; }
.chart text.name { fill: var(--ink); font-weight: 600; }
.plan { width: 100%; height: auto; display: block; margin-top: 12px; }
.table { max-height: none; }
td small { color: var(--soft); }
"""

_THUMBNAIL_PX = 240

# Measures of the tables: name -> (heading, decimals).
_COLUMNS = {
    "psnr": ("PSNR, dB", 2),
    "ssim": ("SSIM", 4),
    "lpips": ("LPIPS", 3),
    "num_gaussians": ("Gaussians", 0),
    "size_mb": ("PLY, MB", 1),
    "rotation_error_deg": ("Rotation error, \u00b0", 3),
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
    buffer = io.BytesIO()
    Image.fromarray(small).save(buffer, "JPEG", quality=84, optimize=True)
    uri = "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()
    return Thumbnail(uri, small.shape[1], small.shape[0], view)


@dataclass(frozen=True)
class Batch:
    """Content of the page of a batch.

    Attributes:
        results: one per run, ordered by scene; at least one.
        renders: run's name -> render of a test view.
        photos: scene -> the photograph of that view.
        plans: scene -> plan of its first run.
        stages: names in the order of the DAG.
    """

    results: Sequence[Result]
    renders: Mapping[str, Thumbnail] = field(default_factory=dict)
    photos: Mapping[str, Thumbnail] = field(default_factory=dict)
    plans: Mapping[str, PlanRecord] = field(default_factory=dict)
    stages: Sequence[str] = ()


def index_html(batch: Batch) -> str:
    """The page as a string; the same batch gives the same bytes."""
    results = batch.results
    scenes = list(by_scene(results))
    sections = [
        ("means", "Configurations", _configs(results)),
        *((f"scene-{i}", scene, _scene(batch, scene)) for i, scene in enumerate(scenes)),
        ("stages", "Time and memory", _stages(results, batch.stages)),
        ("published", "Published numbers", _sources(results, scenes)),
    ]
    sections = [section for section in sections if section[2]]
    links = "".join(f'<a href="#{key}">{escape(title)}</a>' for key, title, _ in sections)
    body = "".join(
        f'<section id="{key}"><h2>{escape(title)}</h2>{inside}</section>'
        for key, title, inside in sections
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<link rel="icon" href="data:,"><title>Batch \u00b7 splatmake</title>'
        f"<style>{CSS}{_CSS}</style></head>\n<body>"
        f'<div class="top"><h1>{count(len(scenes))} {"scene" if len(scenes) == 1 else "scenes"}'
        f'</h1><p class="lead">{_lead(results)}</p><nav>{links}</nav></div>\n'
        f"<main>{_failures(results)}{body}</main>"
        '<div class="foot">Made by splatmake. The numbers are also in benchmark.csv and '
        "benchmark.json.</div></body></html>\n"
    )


def _label(config: str) -> str:
    return config or "as configured"


def _lead(results: Sequence[Result]) -> str:
    done = sum(r.ok for r in results)
    seeds = sorted({r.run.seed for r in results if r.run.seed is not None})
    machines = dict.fromkeys(
        f"{r.machine['host']} ({r.machine['processor'] or 'unknown processor'}) with "
        f"{r.machine['threads']} threads"
        for r in results
        if r.machine
    )
    parts = [f"{done} of {len(results)} runs finished"]
    if seeds:
        parts.append(f"seeds {', '.join(map(str, seeds))}")
    if machines:
        parts.append(f"on {', '.join(machines)}")
    return escape(" \u00b7 ".join(parts))


def _failures(results: Sequence[Result]) -> str:
    lost = [r for r in results if not r.ok]
    if not lost:
        return '<div class="calm">Every run finished</div>'
    rows = "".join(
        f'<tr class="failed"><td>{escape(r.run.name)}</td><td>{escape(r.status)}'
        f"{escape(f' in {r.stage}') if r.stage else ''}</td><td>"
        f"{'<br>'.join(escape(line) for line in r.message.splitlines())}</td></tr>"
        for r in lost
    )
    title = "1 run has no result" if len(lost) == 1 else f"{len(lost)} runs have no result"
    return (
        f'<div class="warnings" role="note"><h2>{title}</h2>'
        f'<div class="table"><table><tbody>{rows}</tbody></table></div></div>'
    )


# --- configurations -----------------------------------------------------------------------


def _configs(results: Sequence[Result]) -> str:
    scenes, over = by_config(results)
    if not scenes:
        hint = "No scene was finished with every configuration, so there is no comparison yet."
        return f'<p class="hint">{hint}</p>' if any(r.ok for r in results) else ""
    # No ranges: over scenes, they describe the scenes rather than the configuration.
    means = {
        config: {name: Spread(s.mean, s.mean, s.mean, 1) for name, s in spreads.items()}
        for config, spreads in over.items()
    }
    table = _table([(escape(_label(config)), _cells(means[config])) for config in means])
    names = ", ".join(scenes)
    return (
        f'<p class="hint">Means over the {count(len(scenes))} scenes that every configuration '
        f"finished: {escape(names)}. Pixel error is the root mean square error that corresponds to "
        "the mean PSNR, in percent of full range. The dashed line is the Pareto front of time and "
        f"error.{_sizes_differ(results, scenes)}</p>"
        + table
        + f'<div class="charts">{_means_charts(results, over)}</div>'
    )


def _sizes_differ(results: Sequence[Result], scenes: Sequence[str]) -> str:
    """A warning if the configurations of a scene were measured on images of different sizes."""
    sizes: dict[str, set[str]] = {}
    for r in results:
        if r.ok and r.run.scene in scenes:
            sizes.setdefault(r.run.scene, set()).add(row(r)["resolution"])
    if all(len(found) < 2 for found in sizes.values()):
        return ""
    return (
        " <strong>Configurations were measured on images of different sizes</strong> (each at its "
        "training resolution). Errors are smaller in smaller images, so these numbers do not show "
        "which configuration is better."
    )


def _means_charts(results: Sequence[Result], over: Mapping[str, Mapping[str, Spread]]) -> str:
    colours = {config: i for i, config in enumerate(over)}
    single = len(over) == 1
    parts = []
    for measure, title, label in _ERRORS:
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
            parts.append(trade_off_chart(points, title=title, x_title="time", y_label=label))
    return "".join(parts)


def _percent(value: float) -> str:
    return f"{value:.3g} %"


_ERRORS = (
    ("psnr", "Pixel error against time", _percent),
    ("ssim", "1 - SSIM against time", lambda value: f"{value:.2g}"),
    ("lpips", "LPIPS against time", lambda value: f"{value:.2g}"),
)


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


def _scene(batch: Batch, scene: str) -> str:
    results = [r for r in batch.results if r.run.scene == scene]
    done = [r for r in results if r.ok]
    means = by_scene(results)[scene]
    first = done[0].metrics
    protocol = first.get("protocol") or {}
    sizes = dict.fromkeys(size for r in done for size in r.metrics["protocol"]["resolution"])
    hint = (
        f"{count(first['registered_images'])} of {count(first['total_images'])} photographs "
        f"registered; measured on {count(protocol.get('num_views'))} views of "
        f"{', '.join(sizes)} pixels, {protocol.get('split', '')}"
    )
    rows = []
    published = published_for(scene, photographs(results, scene))
    for config, spreads in means.items():
        runs = [r for r in done if r.run.config == config]
        names = [f"seed {r.metrics['seed']}" for r in runs] if len(runs) > 1 else [_label(config)]
        pages = " ".join(
            f'<a href="{quote(r.run.name)}/report.html">{escape(name)}</a>'
            for r, name in zip(runs, names, strict=True)
        )
        lead = pages if len(runs) == 1 else f"{escape(_label(config))} <small>{pages}</small>"
        rows.append((lead + (_unlike(runs) if published else ""), _cells(spreads)))
    table = _table(rows, [(f"{p['method']} (published)", p) for p in published])
    chart = ""
    if len(means) > 1:
        points = [
            _chart_point({n: s.mean for n, s in spreads.items()}, "psnr", _label(config), config, i)
            for i, (config, spreads) in enumerate(means.items())
        ]
        title, label = _ERRORS[0][1:]
        chart = trade_off_chart(points, title=title, x_title="time", y_label=label)
        chart = f'<div class="charts single">{chart}</div>'
    plan = batch.plans.get(scene)
    picture = (
        f"<details><summary>Stages that ran or were skipped</summary>{plan_svg(plan)}</details>"
        if plan
        else ""
    )
    return f'<p class="hint">{escape(hint)}</p>{_thumbs(batch, scene, done)}{table}{chart}{picture}'


def _unlike(runs: Sequence[Result]) -> str:
    """The mark of runs that were not measured as published; empty if all were."""
    found = [r.metrics["protocol"].get("published") for r in runs]
    if all(f and not f["deviations"] for f in found):
        return ""
    why = "; ".join(dict.fromkeys(text for f in found if f for text in f["deviations"]))
    return f' <small title="{escape(why)}">(not as published)</small>'


def _thumbs(batch: Batch, scene: str, done: Sequence[Result]) -> str:
    figures = []
    if scene in batch.photos:
        figures.append(_figure(batch.photos[scene], f"photograph {batch.photos[scene].view}", ""))
    first = {r.run.config: r for r in reversed(done)}
    for config, r in reversed(first.items()):
        if r.run.name in batch.renders:
            text = f"{_label(config)}, {fixed(r.metrics['psnr'], 2)} dB"
            figures.append(_figure(batch.renders[r.run.name], text, r.run.name))
    return f'<div class="thumbs">{"".join(figures)}</div>' if figures else ""


def _figure(picture: Thumbnail, caption: str, run: str) -> str:
    image = (
        f'<img src="{picture.uri}" width="{picture.width}" height="{picture.height}" '
        f'alt="{escape(caption)}">'
    )
    inside = f'<a href="{quote(run)}/report.html">{image}</a>' if run else image
    return f"<figure>{inside}<figcaption>{escape(caption)}</figcaption></figure>"


# --- tables -------------------------------------------------------------------------------


def _cells(spreads: Mapping[str, Spread]) -> dict[str, str]:
    """One cell per measure: its mean and, over several seeds or scenes, half of its range."""
    cells = {}
    for name, (_, digits) in _COLUMNS.items():
        if name in spreads:
            s = spreads[name]
            off = f" <small>\u00b1{fixed((s.high - s.low) / 2, digits)}</small>"
            cells[name] = fixed(s.mean, digits) + (off if s.count > 1 else "")
    for name in ("wall_s", "cpu_s"):
        cells[name] = duration(spreads[name].mean) if name in spreads else MISSING
    if "peak_rss_mb" in spreads:
        cells["peak_rss_mb"] = f"{count(spreads['peak_rss_mb'].mean)} MB"
    return cells


def _table(
    rows: Sequence[tuple[str, Mapping[str, str]]],
    published: Sequence[tuple[str, Mapping[str, Any]]] = (),
) -> str:
    """Rows of (lead as HTML, cells by measure), then published ones of (name, numbers)."""
    heads = {name: heading for name, (heading, _) in _COLUMNS.items()} | {
        "wall_s": "Time",
        "cpu_s": "CPU",
        "peak_rss_mb": "Memory",
    }
    known = [n for n in heads if any(n in c for _, c in (*rows, *published))]
    top = "".join(f'<th class="number" scope="col">{heads[name]}</th>' for name in known)
    body = "".join(
        f"<tr><td>{lead}</td>"
        + "".join(f'<td class="number">{cells.get(name, MISSING)}</td>' for name in known)
        + "</tr>"
        for lead, cells in rows
    )
    for name, numbers in published:
        cells = {n: fixed(numbers[n], min(_COLUMNS[n][1], 3)) for n in known if n in numbers}
        body += f'<tr class="published"><td>{escape(name)}</td>'
        body += "".join(f'<td class="number">{cells.get(n, "")}</td>' for n in known) + "</tr>"
    return (
        f'<div class="table"><table><thead><tr><th scope="col"></th>{top}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _stages(results: Sequence[Result], order: Sequence[str]) -> str:
    """Wall time of each stage of each run; CPU time and memory as tooltips."""
    done = [r for r in results if r.ok]
    stages = [s for s in order if any(not _stage(r, s)["skipped"] for r in done)]
    if not done:
        return ""
    heads = "".join(f'<th class="number" scope="col">{escape(s)}</th>' for s in stages)
    body = ""
    for r in done:
        body += f"<tr><td>{escape(r.run.name)}</td>"
        for name in stages:
            s = _stage(r, name)
            if s["skipped"]:
                body += f'<td class="number" title="{escape(s.get("reason", ""))}">-</td>'
            else:
                tip = f"CPU {duration(s['cpu_s'])}, {count(s['peak_rss_mb'])} MB"
                body += f'<td class="number" title="{tip}">{duration(s["wall_s"])}</td>'
        body += "</tr>"
    return (
        '<p class="hint">Wall time; CPU time and peak memory are tooltips. A dash is a skipped '
        "stage. Stages that configurations share ran once; their time is counted for each.</p>"
        f'<div class="table"><table><thead><tr><th scope="col">Run</th>{heads}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _stage(result: Result, name: str) -> Mapping[str, Any]:
    return result.metrics["stages"].get(name, {"skipped": True})


def _sources(results: Sequence[Result], scenes: Sequence[str]) -> str:
    """Source and protocol of every published number on the page."""
    shown = {}
    for scene in scenes:
        for p in published_for(scene, photographs(results, scene)):
            shown[p["method"], p["dataset"]] = p
    items = "".join(
        f"<dt>{escape(method)}, {escape(dataset)}</dt><dd>{escape(p['source'])}.<br>"
        f"{escape(p['protocol'])}.</dd>"
        for (method, dataset), p in shown.items()
    )
    hint = "Comparable with the runs only if resolution, split and photographs are the same."
    return f'<p class="hint">{hint}</p><dl>{items}</dl>' if shown else ""
