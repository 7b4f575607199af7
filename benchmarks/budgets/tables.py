"""Tables of quality by training time."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from benchmarks import markdown
from benchmarks.results import BudgetResult

_BLOCKS = "▁▂▃▄▅▆▇█"
Key = tuple[str, str]
"""Scene and trainer."""


def table(points: Sequence[BudgetResult]) -> str:
    """A row for each scene, trainer and time budget; medians over the seeds."""
    rows = [
        [
            *("scene", "trainer", "test views, pixels", "minutes", "seeds", "PSNR (dB)", "SSIM"),
            *("LPIPS", "Gaussians", "steps", "wall, CPU min of training", "CPU min before"),
            *("threads", "load"),
        ]
    ]
    for group in _groups(points):
        for minutes in sorted({p.minutes for p in group}):
            rows.append(_row([p for p in group if p.minutes == minutes]))
    return markdown.table(_or_dashes(rows))


def curves(points: Sequence[BudgetResult]) -> str:
    """PSNR by time budget: a row for each scene and trainer, and the curve in block characters,
    from the lowest to the highest value of the scene."""
    budgets = sorted({p.minutes for p in points})
    rows = [["scene", "trainer", *(f"{m:g} min" for m in budgets), "curve of PSNR"]]
    for group in _groups(points):
        scene = [p for p in points if p.scene == group[0].scene]
        medians = {m: _psnr(group, m) for m in budgets}
        known = [_psnr(_of(scene, trainer), m) for trainer in _trainers(scene) for m in budgets]
        lowest, highest = _range([value for value in known if value is not None])
        cells = [markdown.cell(value, ".2f") for value in medians.values()]
        blocks = "".join(_block(value, lowest, highest) for value in medians.values())
        rows.append([group[0].scene, group[0].trainer, *cells, blocks])
    return markdown.table(_or_dashes(rows))


def _row(points: Sequence[BudgetResult]) -> list[str]:
    first = points[0]
    lpips = [p.lpips for p in points if p.lpips is not None]
    before = [p.other_cpu_minutes for p in points if p.other_cpu_minutes is not None]
    loads = [p.load_average for p in points if p.load_average is not None]
    times = [
        statistics.median(values)
        for values in ([p.wall_minutes for p in points], [p.cpu_minutes for p in points])
    ]
    return [
        *(first.scene, first.trainer, f"{first.test_views}, {first.pixels}", f"{first.minutes:g}"),
        str(len(points)),
        markdown.middle([p.psnr for p in points], "{:.2f}"),
        markdown.middle([p.ssim for p in points], "{:.3f}"),
        markdown.middle(lpips, "{:.3f}") if lpips else "-",
        f"{statistics.median(p.gaussians for p in points) / 1e3:.0f}k",
        f"{statistics.median(p.steps for p in points):.0f}",
        f"{times[0]:.1f}, {times[1]:.1f}",
        markdown.cell(statistics.median(before) if before else None, ".1f"),
        str(first.threads),
        markdown.cell(max(loads) if loads else None, ".1f"),
    ]


def _or_dashes(rows: list[list[str]]) -> list[list[str]]:
    """A heading without rows gets one of dashes: nothing is measured yet."""
    return rows if len(rows) > 1 else [*rows, ["-"] * len(rows[0])]


def _groups(points: Sequence[BudgetResult]) -> list[list[BudgetResult]]:
    """The points of each scene and trainer, in the order of the record."""
    keys: dict[Key, list[BudgetResult]] = {}
    for point in points:
        keys.setdefault((point.scene, point.trainer), []).append(point)
    return list(keys.values())


def _trainers(points: Sequence[BudgetResult]) -> list[str]:
    return list(dict.fromkeys(p.trainer for p in points))


def _of(points: Sequence[BudgetResult], trainer: str) -> list[BudgetResult]:
    return [p for p in points if p.trainer == trainer]


def _psnr(points: Sequence[BudgetResult], minutes: float) -> float | None:
    values = [p.psnr for p in points if p.minutes == minutes]
    return statistics.median(values) if values else None


def _range(values: Sequence[float]) -> tuple[float, float]:
    return min(values), max(values)


def _block(value: float | None, lowest: float, highest: float) -> str:
    """The block character of a value; a space for None."""
    if value is None:
        return " "
    share = (value - lowest) / (highest - lowest) if highest > lowest else 1.0
    return _BLOCKS[round(share * (len(_BLOCKS) - 1))]
