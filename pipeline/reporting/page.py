"""The report page of a scene: one HTML file that needs no network.

Style, scripts and images are embedded. A content security policy forbids any other request. The
same data gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.metrics.evaluation import PublishedProtocol
from pipeline.reporting.blocks import blocks_section
from pipeline.reporting.charts import histogram, line_chart
from pipeline.reporting.coverage import coverage_section
from pipeline.reporting.data import Comparison, ReportData
from pipeline.reporting.pictures import ERROR_SCALE, page_pictures, scale_gradient
from pipeline.reporting.script import JS
from pipeline.reporting.space import space_section, viewer_script
from pipeline.reporting.style import CSS
from pipeline.reporting.tables import (
    definitions,
    georeference,
    per_view_table,
    stages_table,
)
from pipeline.reporting.text import count, duration, escape, fixed
from pipeline.runtime.atomic import write_text

# The viewer decodes and sorts in WebAssembly, in a worker.
_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline' 'wasm-unsafe-eval'; worker-src blob:"
)

# Of the page, so that it can be sent by mail: common limits are 15 MB or more.
_MAX_BYTES = 14_500_000


def write_report(data: ReportData, path: Path) -> None:
    """Write the page to ``path`` atomically."""
    write_text(path, report_html(data))


def report_html(data: ReportData) -> str:
    """The page as a string."""
    viewer = "" if data.trained is None else f"<script>{viewer_script()}</script>"
    sections = [
        ("pictures", "Photograph and render", _pictures(data.comparisons)),
        ("coverage", "Coverage by the photographs", coverage_section(data)),
        ("training", "Training", _curves(data)),
        ("reconstruction", "Reconstruction", _reconstruction(data)),
        ("views", "All views", per_view_table(data.metrics.get("per_view") or [])),
        ("stages", "Stages", stages_table(data.metrics.get("stages") or {})),
        ("how", "Decisions and protocol", _how(data)),
    ]
    if blocks := blocks_section(data):
        sections.insert(2, ("blocks", "Blocks", blocks))
    max_bytes = _MAX_BYTES - len(viewer) - sum(len(inside) for _, _, inside in sections)
    sections.insert(0, ("scene", "Scene", space_section(data, max_bytes)))
    links = "".join(f'<a href="#{key}">{title}</a>' for key, title, _ in sections)
    body = "".join(
        f'<section id="{key}"><h2>{title}</h2>{inside}</section>' for key, title, inside in sections
    )
    scene = escape(data.scene)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<link rel="icon" href="data:,"><title>{scene} \u00b7 splatmake</title>'
        f"<style>{CSS}</style></head>\n<body>"
        f'<div class="top"><h1>{scene}</h1><p class="lead">{_lead(data)}</p>'
        f"<nav>{links}</nav>{_cards(data)}</div>\n<main>{_warnings(data)}{body}</main>"
        '<div class="foot">Made by splatmake. This page needs no network.</div>'
        f"<script>{JS}</script>{viewer}</body></html>\n"
    )


def _lead(data: ReportData) -> str:
    protocol = data.metrics.get("protocol") or {}
    resolution = protocol.get("resolution")
    sizes = [resolution] if isinstance(resolution, str) else list(resolution or [])
    views = len(data.metrics.get("per_view") or [])
    parts = [str(data.metrics["input"])] if data.metrics.get("input") else []
    parts += [f"Measured on {count(views)} {'view' if views == 1 else 'views'}"]
    if sizes:
        parts.append(str(sizes[0]) if len(sizes) == 1 else f"{sizes[0]} to {sizes[-1]}")
    if protocol.get("split"):
        parts.append(str(protocol["split"]))
    if protocol.get("published"):
        parts.append(PublishedProtocol.model_validate(protocol["published"]).text)
    return escape(" \u00b7 ".join(parts))


def _cards(data: ReportData) -> str:
    m = data.metrics
    stages = (m.get("stages") or {}).values()
    lpips = m.get("lpips")
    protocol = m.get("protocol") or {}
    registered, total = m.get("registered_images"), m.get("total_images")
    train_psnr = m.get("train_psnr")
    note = "" if train_psnr is None else f"; training views: {fixed(train_psnr, 2)} dB"
    plain = m.get("psnr_without_gains")
    note += "" if plain is None else f"; without exposure gains: {fixed(plain, 2)} dB"
    own = m.get("psnr_without_fit")
    note += "" if own is None else f"; without fitted appearance: {fixed(own, 2)} dB"
    whole = f'<span class="unit"> / {count(total)}</span>' if total is not None else ""
    ran = [s for s in stages if not s.get("skipped")]
    cpu, rss = sum(s["cpu_s"] for s in ran), max((s["peak_rss_mb"] for s in ran), default=0.0)
    cards = [
        (
            "first",
            "PSNR",
            f'{fixed(m.get("psnr"), 2)}<span class="unit"> dB</span>',
            f"mean of the views{note}",
        ),
        ("first", "SSIM", fixed(m.get("ssim"), 4), protocol.get("ssim", "")),
        (
            "first",
            "LPIPS",
            fixed(lpips, 4),
            protocol.get("lpips", "") if lpips is not None else m.get("lpips_reason") or "",
        ),
        ("", "Gaussians", count(m.get("num_gaussians")), ""),
        ("", "Images registered", f"{count(registered)}{whole}", ""),
        (
            "",
            "Time",
            duration(sum(s["wall_s"] for s in ran)),
            f"CPU {duration(cpu)}, peak memory {count(rss)} MB",
        ),
    ]
    if m.get("reprojection_error_px") is not None:
        value = f'{fixed(m["reprojection_error_px"], 3)}<span class="unit"> px</span>'
        cards.append(("", "Reprojection error", value, "mean of the sparse points"))
    pose = m.get("pose_error")
    if pose:
        value = f'{fixed(pose.get("rotation_median_deg"), 4)}<span class="unit">\u00b0</span>'
        centre = pose.get("centre_median")
        note = "" if centre is None else f"median centre error {centre:.4g} (truth's unit)"
        cards.append(("", "Rotation error, median", value, note))
    rows = []
    for row in ("first", ""):
        inside = "".join(
            f'<div class="card {kind}"><div class="name">{name}</div>'
            f'<div class="value">{value}</div><div class="note">{escape(note)}</div></div>'
            for kind, name, value, note in cards
            if kind == row
        )
        rows.append(f'<div class="cards">{inside}</div>')
    return "".join(rows)


def _warnings(data: ReportData) -> str:
    both = [*(data.metrics.get("warnings") or []), *(data.plan.warnings if data.plan else [])]
    texts = list(dict.fromkeys(str(text) for text in both))
    if not texts:
        return '<div class="calm">No warnings</div>'
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    title = "1 warning" if len(texts) == 1 else f"{len(texts)} warnings"
    return f'<div class="warnings" role="note"><h2>{title}</h2><ul>{items}</ul></div>'


def _nothing(what: str) -> str:
    return f'<p class="hint">{what}</p>'


def _choice(target: str, toggle: str, off: str, on: str) -> str:
    """Two radio buttons that add the class ``toggle`` to the element ``target``, or remove it."""
    buttons = "".join(
        f'<label><input type="radio" name="{toggle}" value="{value}" data-toggle="{toggle}" '
        f'data-target="{target}"{" checked" if value == "off" else ""}>{text}</label>'
        for value, text in (("off", off), ("on", on))
    )
    return f'<div class="choice" role="radiogroup">{buttons}</div>'


def _pictures(views: Iterable[Comparison]) -> str:
    views = list(views)
    if not views:
        return _nothing("No view was recorded for comparison.")
    grey = "<b></b>masked" if any(v.mask is not None and not v.mask.all() for v in views) else ""
    parts = [
        '<div class="bar-top">'
        + _choice("pictures", "sliding", "Side by side", "Slider")
        + f'<div class="scale">error 0<i style="background: {scale_gradient()}"></i>'
        f"{ERROR_SCALE:g} of full range or more{grey}</div></div>"
    ]
    for view, row in zip(views, page_pictures(views), strict=True):
        name = escape(view.name)
        figures = "".join(
            f'<figure class="{kind}"><img src="{uri}" width="{width}" height="{height}" '
            f'alt="{kind} {name}"><figcaption>{kind}</figcaption></figure>'
            for kind, (uri, width, height) in zip(
                ("photograph", "render", "error"), row, strict=True
            )
        )
        tall = " tall" if row[0][2] > row[0][1] else ""
        parts.append(
            f'<article class="view"><header><span class="badge {view.label}">{view.label}</span>'
            f"<h3>{name}</h3><span>PSNR {fixed(view.psnr, 2)} dB \u00b7 SSIM "
            f'{fixed(view.ssim, 4)}</span></header><div class="triple{tall}">{figures}'
            '<input type="range" min="0" max="100" value="50" step="0.5" '
            f'aria-label="photograph or render of {name}"><div class="divider"></div>'
            "</div></article>"
        )
    return "".join(parts)


def _curves(data: ReportData) -> str:
    if not data.curve:
        return _nothing("No curve was recorded.")
    values = [record.values for record in data.curve]
    kinds: list[tuple[list[float], str, Callable[[float], str], bool]] = [
        ([v.loss for v in values], "Loss", lambda y: f"{y:.4g}", True),
        ([v.psnr for v in values], "PSNR on training views, dB", lambda y: f"{y:.2f} dB", False),
        ([v.num_gaussians for v in values], "Gaussians", lambda y: f"{y:,.0f}", False),
    ]

    def charts(xs: Sequence[float], x_title: str, timed: bool) -> str:
        return "".join(
            line_chart(xs, ys, title=title, x_title=x_title, y_label=label, timed=timed, log=log)
            for ys, title, label, log in kinds
        )

    by_step = charts([v.step for v in values], "step", timed=False)
    by_time = charts([record.seconds for record in data.curve], "time", timed=True)
    return (
        f'<div class="bar-top">{_choice("training", "timed", "By step", "By time")}</div>'
        f'<div class="charts by-step">{by_step}</div><div class="charts by-time">{by_time}</div>'
    )


def _reconstruction(data: ReportData) -> str:
    parts = []
    errors = np.asarray(data.reprojection_errors, np.float64)
    errors = errors[np.isfinite(errors) & (errors >= 0)]  # -1 where unknown
    lengths = np.asarray(data.track_lengths, np.float64)
    if len(errors):
        title = f"Reprojection error of points (median {np.median(errors):.3f} px)"
        parts.append(histogram(errors, title=title, x_title="pixels"))
    if len(lengths):
        title = f"Track length (mean {lengths.mean():.2f} images)"
        parts.append(histogram(lengths, title=title, x_title="images that see a point", whole=True))
    out = f'<div class="charts">{"".join(parts)}</div>' if parts else ""
    pose = data.metrics.get("pose_error")
    if pose:
        out += "<h3>Pose errors against ground truth</h3>" + definitions(pose)
    placed = data.metrics.get("georeference")
    if placed and placed.get("origin"):
        out += f"<h3>Georeferencing</h3>{georeference(placed)}"
    return out or _nothing("No points or tracks were recorded, and there are no true poses.")


def _how(data: ReportData) -> str:
    m = data.metrics
    decided = {s: texts for s, texts in data.decisions.items() if texts}
    if decided:
        rows = "".join(
            f"<dt>{escape(stage)}</dt><dd>{'<br>'.join(escape(t) for t in texts)}</dd>"
            for stage, texts in decided.items()
        )
        decisions = f"<dl>{rows}</dl>"
    else:
        decisions = _nothing("No decision was recorded.")
    return (
        f'<div class="columns"><div><h3>Decisions</h3>{decisions}</div>'
        f"<div><h3>Protocol</h3>{definitions(m.get('protocol') or {})}"
        f"<h3>Versions</h3>"
        f"{definitions({**(m.get('versions') or {}), 'seed': m.get('seed')})}</div></div>"
        + _raw("metrics.json", m)
        + (_raw("plan.json", data.plan.model_dump(mode="json")) if data.plan else "")
    )


def _raw(name: str, value: Mapping[str, Any]) -> str:
    text = json.dumps(value, indent=2, ensure_ascii=False)
    return f"<details><summary>{name}</summary><pre>{escape(text)}</pre></details>"
