"""Tables and lists of the report page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.reporting.text import MISSING, count, duration, escape, fixed, plain

# Measures of a view: name -> (heading, decimals).
_MEASURES = {"psnr": ("PSNR, dB", 2), "ssim": ("SSIM", 4), "lpips": ("LPIPS", 4)}

_NAMES = {
    "rotation_median_deg": "rotation error, median, degrees",
    "rotation_mean_deg": "rotation error, mean, degrees",
    "centre_median": "centre error, median, truth's unit",
    "centre_mean": "centre error, mean, truth's unit",
    "centre_relative_median": "centre error, median, share of the radius",
    "radius": "radius of the cameras, truth's unit",
    "scale": "truth's units per unit of the model",
    "auc": "AUC of relative poses (degrees: share)",
    "num_common": "cameras compared",
    "num_truth": "true cameras",
}


def definitions(values: Mapping[str, Any]) -> str:
    """Names and values; known names are spelled out."""
    if not values:
        return f'<p class="hint">{MISSING}</p>'
    rows = "".join(
        f"<dt>{escape(_NAMES.get(name, name.replace('_', ' ')))}</dt><dd>{escape(plain(v))}</dd>"
        for name, v in values.items()
    )
    return f"<dl>{rows}</dl>"


def georeference(placed: Mapping[str, Any]) -> str:
    """Method, origin and residuals of the georeferencing."""
    left, known = placed.get("residuals_m") or {}, placed.get("uncertainty") or {}
    values = {
        "method": {"gps": "GPS", "gcp": "ground control points"}.get(placed["method"]),
        **(placed.get("origin") or {}),
        "positions used": left.get("used"),
        "rejected as outliers": left.get("left_out"),
        "observations, degrees of freedom": _joined(left, "observations", "freedoms"),
        "horizontal residual, median and largest, m": _pair(left, "horizontal"),
        "vertical residual, median and largest, m": _pair(left, "vertical"),
        "standard deviation of the scale (relative)": known.get("scale"),
        "standard deviation of heading and tilt, degrees": _joined(
            known, "heading_deg", "tilt_deg"
        ),
    }
    return definitions({name: value for name, value in values.items() if value is not None})


def _joined(values: Mapping[str, Any], first: str, second: str) -> str | None:
    return f"{values[first]:g}, {values[second]:g}" if first in values else None


def _pair(left: Mapping[str, Any], axis: str) -> str | None:
    if left.get(f"{axis}_median") is None:
        return None
    return f"{left[f'{axis}_median']:.3f}, {left[f'{axis}_max']:.3f}"


def per_view_table(per_view: Sequence[Mapping[str, Any]]) -> str:
    """A sortable table of the views; measures that no view has are omitted."""
    if not per_view:
        return '<p class="hint">No view was measured.</p>'
    known = [key for key in _MEASURES if any(view.get(key) is not None for view in per_view)]
    heads = "".join(
        f'<th class="number" scope="col"><button>{_MEASURES[key][0]}</button></th>' for key in known
    )
    spans = {key: _span([view.get(key) for view in per_view]) for key in known}
    rows = []
    for view in per_view:
        name = escape(view["name"])
        cells = [f'<td class="name" data-value="{name}">{name}</td>']
        for key in known:
            value = view.get(key)
            sort = "" if value is None else repr(float(value))
            bar = "" if value is None else _bar(value, *spans[key])
            cells.append(
                f'<td class="number" data-value="{sort}">{fixed(value, _MEASURES[key][1])}'
                f"{bar}</td>"
            )
        rows.append(f"<tr>{''.join(cells)}</tr>")
    return (
        '<div class="table"><table><thead><tr><th scope="col"><button>View</button></th>'
        f"{heads}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def stages_table(stages: Mapping[str, Mapping[str, Any]]) -> str:
    """Time and memory of the stages that ran, and the reason why others did not."""
    if not stages:
        return '<p class="hint">No stage was recorded.</p>'
    longest = max((s["wall_s"] for s in stages.values()), default=0.0)
    rows = []
    for name, stage in stages.items():
        reason = escape(stage.get("reason") or "")
        if stage.get("skipped"):
            cells = '<td><span class="pill">skipped</span></td>' + 3 * '<td class="number">-</td>'
            rows.append(f'<tr class="skipped"><td>{escape(name)}</td>{cells}<td>{reason}</td></tr>')
            continue
        rows.append(
            f'<tr><td>{escape(name)}</td><td><span class="pill run">run</span></td>'
            f'<td class="number">{duration(stage["wall_s"])}{_bar(stage["wall_s"], 0.0, longest)}'
            f'</td><td class="number">{duration(stage["cpu_s"])}</td>'
            f'<td class="number">{count(stage["peak_rss_mb"])} MB</td><td>{reason}</td></tr>'
        )
    heads = '<th scope="col">Stage</th><th scope="col"></th>' + "".join(
        f'<th class="number" scope="col">{name}</th>' for name in ("Wall time", "CPU", "Memory")
    )
    return (
        f'<div class="table"><table><thead><tr>{heads}<th scope="col">Reason</th></tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _span(values: Sequence[float | None]) -> tuple[float, float]:
    found = [v for v in values if v is not None and math.isfinite(v)]
    low, high = min(found, default=0.0), max(found, default=1.0)
    return low - 0.12 * (high - low), high  # the smallest value has a visible bar


def _bar(value: float, low: float, high: float) -> str:
    share = (value - low) / (high - low) if high > low else 1.0
    return f'<meter-bar><i style="width: {100 * min(max(share, 0.0), 1.0):.0f}%"></i></meter-bar>'
