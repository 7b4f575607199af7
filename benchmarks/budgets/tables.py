"""Tables of quality by training time."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from benchmarks import markdown
from benchmarks.results import BudgetResult

_BLOCKS = "▁▂▃▄▅▆▇█"


def table(points: Sequence[BudgetResult]) -> str:
    """A row for each scene and time budget; medians over the seeds."""
    rows = [
        [
            *("scene", "test views, pixels", "minutes", "seeds", "PSNR (dB)", "SSIM"),
            *("LPIPS", "Gaussians", "steps", "wall, CPU min of training", "CPU min before"),
            *("threads", "load"),
        ]
    ]
    for group in _groups(points):
        for minutes in sorted({p.minutes for p in group}):
            rows.append(_row([p for p in group if p.minutes == minutes]))
    return markdown.table(_or_dashes(rows))


def curves(points: Sequence[BudgetResult]) -> str:
    """PSNR by time budget: a row for each scene, and the curve in block characters, from its lowest
    to its highest value."""
    budgets = sorted({p.minutes for p in points})
    rows = [["scene", *(f"{m:g} min" for m in budgets), "curve of PSNR"]]
    for group in _groups(points):
        medians = [_psnr(group, m) for m in budgets]
        known = [value for value in medians if value is not None]
        cells = [markdown.cell(value, ".2f") for value in medians]
        blocks = "".join(_block(value, min(known), max(known)) for value in medians)
        rows.append([group[0].scene, *cells, blocks])
    return markdown.table(_or_dashes(rows))


def _row(points: Sequence[BudgetResult]) -> list[str]:
    first = points[0]
    lpips = [p.lpips for p in points if p.lpips is not None]
    loads = [p.load_average for p in points if p.load_average is not None]
    times = [
        statistics.median(values)
        for values in ([p.wall_minutes for p in points], [p.cpu_minutes for p in points])
    ]
    return [
        *(first.scene, f"{first.test_views}, {first.pixels}", f"{first.minutes:g}"),
        str(len(points)),
        markdown.middle([p.psnr for p in points], "{:.2f}"),
        markdown.middle([p.ssim for p in points], "{:.3f}"),
        markdown.middle(lpips, "{:.3f}") if lpips else "-",
        f"{statistics.median(p.gaussians for p in points) / 1e3:.0f}k",
        f"{statistics.median(p.steps for p in points):.0f}",
        f"{times[0]:.1f}, {times[1]:.1f}",
        f"{statistics.median(p.other_cpu_minutes for p in points):.1f}",
        str(first.threads),
        markdown.cell(max(loads) if loads else None, ".1f"),
    ]


def _or_dashes(rows: list[list[str]]) -> list[list[str]]:
    """The rows, with a row of dashes below a heading for which nothing is measured yet."""
    return rows if len(rows) > 1 else [*rows, ["-"] * len(rows[0])]


def _groups(points: Sequence[BudgetResult]) -> list[list[BudgetResult]]:
    """The points of each scene, in the order of the record."""
    scenes: dict[str, list[BudgetResult]] = {}
    for point in points:
        scenes.setdefault(point.scene, []).append(point)
    return list(scenes.values())


def _psnr(points: Sequence[BudgetResult], minutes: float) -> float | None:
    values = [p.psnr for p in points if p.minutes == minutes]
    return statistics.median(values) if values else None


def _block(value: float | None, lowest: float, highest: float) -> str:
    """The block character of a value; a space for None."""
    if value is None:
        return " "
    share = (value - lowest) / (highest - lowest) if highest > lowest else 1.0
    return _BLOCKS[round(share * (len(_BLOCKS) - 1))]
