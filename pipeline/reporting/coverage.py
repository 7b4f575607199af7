"""The coverage section of a report page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.coverage.record import (
    CoverageRecord,
    ErrorByTrust,
    ProposedViewpoint,
    ViewCoverage,
)
from pipeline.reporting.data import CoverageSection, ReportData, TrainedScene
from pipeline.reporting.pictures import data_uri, trust_colours, trust_gradient, upright
from pipeline.reporting.space import upright_frame
from pipeline.reporting.text import count, escape, fixed

_ABOVE = 440  # side of the map, pixels
_MARGIN = 28
_TICK = 17  # length of the line that shows a viewing direction, pixels


def coverage_section(data: ReportData) -> str:
    """HTML of the section."""
    shown = data.coverage
    if shown is None:
        return '<p class="hint">No coverage was recorded.</p>'
    record = shown.record
    if record.reason:
        return f'<p class="hint">No coverage was measured: {escape(record.reason)}.</p>'
    orientations = data.trained.orientations if data.trained else {}
    worst = [view for view in record.views if view.trust_map is not None]
    return (
        '<p class="hint">Trust is a number from 0 to 1 for each pixel: how well the photographs '
        "determine the surface point that it shows, from their number, the angles between them, "
        "their resolution and the angle to this view. The photograph that the view is compared "
        "with is not used.</p>"
        f'<div class="scale">trust 0<i style="background: {trust_gradient()}"></i>1</div>'
        f'<div class="unseen"><div>{_views(shown, worst, orientations)}{_facts(record)}'
        f"{_above(record.viewpoints, data.trained)}</div><div>{_viewpoints(shown)}</div></div>"
    )


def _views(
    shown: CoverageSection, views: Sequence[ViewCoverage], orientations: Mapping[str, int]
) -> str:
    if not views:
        return ""
    items = "".join(
        f"<li><p>{escape(view.name)}: mean trust {fixed(view.mean_trust, 2)}, PSNR "
        f"{fixed(view.psnr, 2)} dB</p>{_pair(shown, view, orientations.get(view.name, 1))}</li>"
        for view in sorted(views, key=lambda view: view.mean_trust or 0.0)
    )
    return f"<h3>Test views of least trust</h3><ol>{items}</ol>"


def _facts(record: CoverageRecord) -> str:
    rows: list[tuple[str, str]] = []
    if record.surface is not None:
        seen = record.surface.seen_by
        shares = f"by 1: {seen.one:.1%}, by 2: {seen.two:.1%}, by 3 or more: "
        rows += [
            ("surface seen by photographs", f"{shares}{seen.three_or_more:.1%}"),
            ("parallax, median", f"{fixed(record.surface.median_parallax_deg, 0)}\u00b0 or more"),
        ]
    if record.views:
        holes = np.mean([view.hole_share for view in record.views])
        floating = np.mean([view.floater_share for view in record.views])
        rows += [
            ("holes in test views", f"{holes:.2%} of pixels"),
            ("floaters in test views", f"{floating:.2%} of pixels"),
        ]
    if record.floaters is not None:
        by_camera = record.floaters.by_camera
        near = ", ".join(f"{name} ({number})" for name, number in by_camera.items())
        number = f"{count(record.floaters.num_gaussians)} Gaussians"
        rows.append(("floaters near cameras", number + (f", near {near}" if near else "")))
    if record.error is not None:
        rows += _error_rows(record.error)
    inside = "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in rows)
    return f"<dl>{inside}</dl>"


def _error_rows(error: ErrorByTrust) -> list[tuple[str, str]]:
    rows = []
    if error.rank_correlation is not None:
        text = (
            f"rank correlation {_signed(error.rank_correlation)} over {count(error.num_blocks)} "
            "blocks of test views (\u22121: low trust always means high error; 0: no relation)"
        )
        rows.append(("trust and squared error", text))
    for row in error.by_trust:
        low, high = row.trust_range
        text = f"{fixed(row.rmse, 3)} ({row.share:.1%} of blocks)"
        rows.append((f"RMS error where trust is {low:g} to {high:g}", text))
    return rows


def _viewpoints(shown: CoverageSection) -> str:
    viewpoints = shown.record.viewpoints
    if not viewpoints:
        return "<h3>To photograph next</h3><p>No nearby viewpoint would add much trust.</p>"
    items = "".join(
        f"<li><p><b>{i + 1}.</b> {escape(_sentence(view.description))} {view.unknown_percent:.0f} "
        f"% of this view is unknown; a photograph would add {view.gain_percent:.0f} % of the "
        f"trust that is missing around the photographs.</p>{_pair(shown, view, 1)}</li>"
        for i, view in enumerate(viewpoints)
    )
    return (
        '<h3>To photograph next</h3><p class="hint">Each gain is in addition to the proposals '
        "before it. The images are the current render from there, and its trust.</p>"
        f"<ol>{items}</ol>"
    )


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + "."


def _pair(shown: CoverageSection, entry: ViewCoverage | ProposedViewpoint, orientation: int) -> str:
    assert entry.render is not None and entry.trust_map is not None
    render, trust = shown.pictures[entry.render], shown.pictures[entry.trust_map]
    pictures = (("render", render), ("trust", trust_colours(trust)))
    images = "".join(
        f'<img src="{data_uri(picture)}" width="{picture.shape[1]}" height="{picture.shape[0]}" '
        f'alt="{kind}">'
        for kind, picture in ((kind, upright(p, orientation)) for kind, p in pictures)
    )
    return f'<div class="pair">{images}</div>'


def _above(viewpoints: Sequence[ProposedViewpoint], scene: TrainedScene | None) -> str:
    """Map of the cameras and proposed viewpoints, as SVG."""
    if scene is None or not scene.views or not viewpoints:
        return ""
    frame = upright_frame(np.stack([view.world_to_camera[:3, :3] for view in scene.views]))
    plan = frame[[0, 2]]
    cameras = np.stack([view.centre for view in scene.views]) @ plan.T
    positions = np.array([v.position for v in viewpoints])
    places = scene.normalization.to_scene(positions) @ plan.T
    both = np.concatenate([cameras, places])
    low, size = both.min(axis=0), float(np.ptp(both, axis=0).max())
    scale = (_ABOVE - 2 * _MARGIN) / size if size > 0 else 1.0
    height = 2 * _MARGIN + scale * float(np.ptp(both[:, 1]))

    def at(place: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(_MARGIN + (place - low) * scale)

    marks = []
    for view, place in zip(scene.views, at(cameras), strict=True):
        kind = "test" if view.is_test else "train"
        marks.append(
            f'<circle class="{kind}" cx="{place[0]:.1f}" cy="{place[1]:.1f}" r="4"><title>'
            f"{escape(view.name)}</title></circle>"
        )
    for i, (viewpoint, place) in enumerate(zip(viewpoints, at(places), strict=True)):
        end = place + _TICK * (plan @ np.array(viewpoint.direction))
        marks.append(
            f'<path class="next" d="M{place[0]:.1f} {place[1]:.1f}L{end[0]:.1f} {end[1]:.1f}"/>'
            f'<circle class="next" cx="{place[0]:.1f}" cy="{place[1]:.1f}" r="6"/>'
            f'<text x="{place[0]:.1f}" y="{place[1] - 9:.1f}">{i + 1}</text>'
        )
    return (
        f'<h3>From above</h3><svg class="above" viewBox="0 0 {_ABOVE} {height:.0f}" role="img" '
        f'aria-label="cameras and viewpoints from above">{"".join(marks)}</svg>'
    )


def _signed(value: float) -> str:
    return fixed(value, 2).replace("-", "\u2212")
