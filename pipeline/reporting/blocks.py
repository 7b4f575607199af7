"""The blocks of a scene on its page: a map from above, and the training of each block."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.reporting.data import ReportData
from pipeline.reporting.text import count, duration, fixed
from pipeline.scene.blocks import Partition

_WIDTH, _MARGIN = 560, 14
_MAX_POINTS = 3000
# The map shows the points between these quantiles, along each axis.
_SHOWN = 0.02, 0.98


def blocks_section(data: ReportData) -> str:
    """The section; empty for a scene that was trained as one block."""
    if data.blocks is None:
        return ""
    return f"{_map(data, data.blocks.partition)}{_table(data)}"


def _map(data: ReportData, partition: Partition) -> str:
    """An SVG element: blocks with their margins, sparse points and training cameras from above."""
    axes = np.array(partition.axes)[:2]
    step = max(1, len(data.points_xyz) // _MAX_POINTS)
    points, colors = _flat(axes, data.points_xyz[::step]), data.points_rgb[::step]
    views = data.trained.views if data.trained is not None else ()
    cameras = _flat(axes, np.array([v.centre for v in views if not v.is_test]).reshape(-1, 3))
    low, high = _extent(points, cameras)
    scale = (_WIDTH - 2 * _MARGIN) / (high[0] - low[0])
    height = (high[1] - low[1]) * scale + 2 * _MARGIN

    def place(x: float, y: float) -> tuple[float, float]:
        x, y = min(max(x, low[0]), high[0]), min(max(y, low[1]), high[1])
        return _MARGIN + (x - low[0]) * scale, height - _MARGIN - (y - low[1]) * scale

    parts = [
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1" fill="rgb({r},{g},{b})"/>'
        for (x, y), (r, g, b) in zip((place(*p) for p in points), colors.tolist(), strict=True)
    ]
    parts += [
        f'<circle class="camera" cx="{x:.1f}" cy="{y:.1f}" r="2.2"/>'
        for x, y in (place(*p) for p in cameras)
    ]
    for number in range(1, len(partition.blocks) + 1):
        for kind, box in (("region", partition.region(number)), ("block", partition.box(number))):
            left, bottom = place(*box.lower[:2])
            right, top = place(*box.upper[:2])
            parts.append(
                f'<rect class="{kind}" x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" '
                f'height="{bottom - top:.1f}"/>'
            )
        parts.append(f'<text x="{left + 8:.1f}" y="{top + 18:.1f}">{number}</text>')
    return (
        f'<svg class="blocks" viewBox="0 0 {_WIDTH} {height:.0f}" role="img" '
        f'aria-label="map of {len(partition.blocks)} blocks from above">{"".join(parts)}</svg>'
        '<p class="hint">From above: blocks, their margins (dashed), training cameras and sparse '
        "points. Outer blocks extend to infinity.</p>"
    )


def _flat(axes: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    # einsum, not a matrix product: BLAS may round differently with the number of threads.
    return np.einsum("ij,nj->ni", axes, points)


def _extent(
    points: NDArray[np.float64], cameras: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper corner of the map, never without an extent."""
    corners = [np.quantile(points, _SHOWN, axis=0)] if len(points) else []
    corners += [np.stack([cameras.min(0), cameras.max(0)])] if len(cameras) else []
    if not corners:
        return np.zeros(2), np.ones(2)
    low = np.min([c[0] for c in corners], 0)
    high = np.max([c[1] for c in corners], 0)
    border = max(1e-9, 0.04 * float((high - low).max()))
    return low - border, high + border


def _table(data: ReportData) -> str:
    assert data.blocks is not None
    heads = ("Block", "Views", "Megapixels", "Gaussians", "PSNR", "Wall time", "Memory")
    rows = [
        f"<tr><td>{number}</td>"
        + "".join(
            f'<td class="number">{value}</td>'
            for value in (
                count(len(block.views)),
                fixed(block.pixels / 1e6, 1),
                count(run.gaussians),
                f"{fixed(run.psnr, 2)} dB",
                duration(run.wall_s),
                f"{count(run.peak_rss_mb)} MB",
            )
        )
        + "</tr>"
        for number, (block, run) in enumerate(
            zip(data.blocks.partition.blocks, data.blocks.runs, strict=True), 1
        )
    ]
    head = "".join(
        f'<th scope="col"{"" if name == "Block" else " class=number"}>{name}</th>' for name in heads
    )
    return (
        f'<div class="table"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
        '<p class="hint">PSNR of the training views, over the part in which each shows the block. '
        "Times of both rounds.</p>"
    )
