"""The report page of a scene: one HTML file that needs no network.

Style, scripts and images are embedded. A content security policy forbids any other request, but for
that of a file with all Gaussians beside the page of a large scene. The same results give the same
bytes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.reporting.blocks import blocks_map
from pipeline.reporting.charts import histogram, line_chart
from pipeline.reporting.coverage import coverage_content
from pipeline.reporting.dag import plan_svg
from pipeline.reporting.data import SceneResults, TrainingRecord
from pipeline.reporting.html import Section, render
from pipeline.reporting.metrics import TimedMetrics
from pipeline.reporting.names import with_photograph_names
from pipeline.reporting.pictures import ERROR_SCALE, embedded, page_pictures, scale_gradient
from pipeline.reporting.publish import MARK
from pipeline.reporting.space import (
    ViewerContent,
    viewer_content,
    viewer_poster,
    viewer_script,
    write_all,
)
from pipeline.reporting.verdict import grouped_warnings, verdict
from pipeline.runtime.atomic import write_text
from pipeline.scene.georeference import GeoreferenceSummary
from pipeline.scene.reconstruction import Points

# The page can be sent by mail: common limits are 15 MB or more.
_MAX_BYTES = 14_500_000


class Measure(NamedTuple):
    """A column of the table of views: its heading, decimals, and the range of its bars."""

    name: str
    heading: str
    digits: int
    low: float
    high: float


def write_report(results: SceneResults, path: Path) -> None:
    """Write the page to ``path`` and, beside it, the Gaussians that are too many for it."""
    write_all(results, path.parent)
    write_text(path, report_html(results))


def report_html(results: SceneResults) -> str:
    """The page as a string."""
    raw = _embedded_records(results)
    results = with_photograph_names(results)
    metrics = results.metrics
    masked = any(v.mask is not None and not v.mask.all() for v in results.comparisons)
    pictures = {
        "rows": list(zip(results.comparisons, page_pictures(results.comparisons), strict=True)),
        "gradient": scale_gradient(),
        "scale": ERROR_SCALE,
        "masked": masked,
    }
    reconstruction = {
        "charts": _point_charts(results.points),
        "georeference": _georeference(metrics.georeference) if metrics.georeference else None,
    }
    coverage = coverage_content(results)
    contents: list[tuple[str, str, Any]] = [
        ("pictures", "Photograph and render", pictures),
        ("coverage", "What to photograph next", coverage),
        ("figures", "Figures", None),
        ("views", "All test views", _measures(metrics)),
        ("trust", "Coverage by the photographs", coverage),
        ("training", "Training", _curve_charts(results.curve)),
        ("reconstruction", "Reconstruction", reconstruction),
        ("stages", "Stages", plan_svg(results.plan)),
        ("how", "Decisions and protocol", raw),
    ]
    if results.blocks is not None:
        contents.insert(5, ("blocks", "Blocks", blocks_map(results, results.blocks.partition)))
    if results.holes is not None:
        invented = [[embedded(picture) for picture in row] for row in results.holes.pictures]
        contents.insert(1, ("holes", "What is invented", invented))
    sections = [
        Section(key, title, f"scene/{key}.html.jinja", content)
        for key, title, content in contents
        if key not in _missing(results)
    ]

    def page(viewer: ViewerContent) -> Markup:
        return render(
            "scene/page.html.jinja",
            results=results,
            metrics=metrics,
            verdict=verdict(metrics, results.coverage.record),
            warnings=grouped_warnings(metrics.warnings, results.plan.order),
            section=Section("scene", "Scene", "scene/viewer.html.jinja", viewer),
            sections=sections,
            mark=Markup(MARK),
            viewer=viewer_script(),
        )

    # The Gaussians get what the rest of the page leaves.
    rest = page(ViewerContent("", Markup(), "", viewer_poster(results)))
    return page(viewer_content(results, _MAX_BYTES - len(rest)))


def _embedded_records(results: SceneResults) -> dict[str, str]:
    """The records as they are in their files, by the files' names."""
    records = {"metrics.json": results.metrics, "plan.json": results.plan}
    return {
        name: json.dumps(record.model_dump(mode="json"), indent=2, ensure_ascii=False)
        for name, record in records.items()
    }


def _missing(results: SceneResults) -> set[str]:
    """Sections without content, which the page leaves out."""
    record = results.coverage.record
    present = {
        "pictures": results.comparisons,
        "coverage": record.viewpoints or results.metrics.gaps,
        "trust": not record.reason,
        "training": results.curve,
        "views": results.metrics.per_view,
    }
    return {name for name, content in present.items() if not content}


def _curve_charts(curve: Sequence[TrainingRecord]) -> dict[str, list[Markup]]:
    """The charts of the training curve against steps and against time."""
    if not curve:
        return {}
    values = [record.values for record in curve]
    kinds: list[tuple[list[float], str, Callable[[float], str], bool]] = [
        ([v.loss for v in values], "Loss", lambda y: f"{y:.4g}", True),
        ([v.psnr for v in values], "PSNR on training views, dB", lambda y: f"{y:.2f} dB", False),
        ([v.num_gaussians for v in values], "Gaussians", lambda y: f"{y:,.0f}", False),
    ]
    axes: dict[str, list[float]] = {
        "step": [v.step for v in values],
        "time": [record.seconds for record in curve],
    }
    return {
        axis: [
            line_chart(
                xs, ys, title=title, x_title=axis, y_label=label, timed=axis == "time", log=log
            )
            for ys, title, label, log in kinds
        ]
        for axis, xs in axes.items()
    }


def _point_charts(points: Points) -> list[Markup]:
    """Histograms of the sparse points' errors and track lengths."""
    charts = []
    errors = points.error[np.isfinite(points.error) & (points.error >= 0)]  # -1 where unknown
    lengths = points.track_length
    if len(errors):
        title = f"Reprojection error of points (median {np.median(errors):.3f} px)"
        charts.append(histogram(errors, title=title, x_title="pixels"))
    if len(lengths):
        title = f"Track length (mean {lengths.mean():.2f} images)"
        charts.append(
            histogram(lengths, title=title, x_title="images that see a point", whole=True)
        )
    return charts


def _georeference(placed: GeoreferenceSummary) -> dict[str, Any] | None:
    """Method, origin and residuals of the georeferencing; None without an origin."""
    if placed.origin is None:
        return None
    left, known = placed.residuals_m, placed.uncertainty
    method = {"gps": "GPS", "gcp": "ground control points"}.get(placed.method)
    values: dict[str, Any] = {"method": method, **placed.origin.model_dump()}
    if left:
        values |= {
            "positions used": left.used,
            "rejected as outliers": left.left_out,
            "observations, degrees of freedom": f"{left.observations}, {left.freedoms}",
            "horizontal residual, median and largest, m": (
                f"{left.horizontal_median:.3f}, {left.horizontal_max:.3f}"
            ),
        }
        if left.vertical_median is not None:
            values["vertical residual, median and largest, m"] = (
                f"{left.vertical_median:.3f}, {left.vertical_max:.3f}"
            )
    if known:
        values |= {
            "standard deviation of the scale (relative)": known.scale,
            "standard deviation of heading and tilt, degrees": (
                f"{known.heading_deg:g}, {known.tilt_deg:g}"
            ),
        }
    return {name: value for name, value in values.items() if value is not None}


def _measures(metrics: TimedMetrics) -> list[Measure]:
    """The measures that at least one view has."""
    found = []
    for name, heading, digits in (
        ("psnr", "PSNR, dB", 2),
        ("ssim", "SSIM", 4),
        ("flip", "FLIP", 4),
        ("lpips", "LPIPS", 4),
    ):
        values = [getattr(view, name) for view in metrics.per_view]
        known = [value for value in values if value is not None and math.isfinite(value)]
        if known:
            low, high = min(known), max(known)
            # The smallest value has a visible bar.
            found.append(Measure(name, heading, digits, low - 0.12 * (high - low), high))
    return found
