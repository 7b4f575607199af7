"""Line charts and histograms as SVG elements for HTML pages.

Colours are CSS variables of the page (light and dark theme). The same data gives the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from pipeline.reporting.html import render

_WIDTH, _HEIGHT = 440, 250
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 14, 14, 40

Label = Callable[[float], str]


def short(value: float) -> str:
    """Label of a tick: 1500 -> 1.5k, 0.25 -> 0.25."""
    for limit, unit in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= limit:
            return f"{value / limit:.4g}{unit}"
    return f"{value:.4g}"


def clock(seconds: float) -> str:
    """Label of a tick on a time axis: 90 -> 1:30, 5400 -> 1:30:00."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
    return f"{whole // 60}:{whole % 60:02d}"


def linear_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Round numbers within [low, high], at most ``most`` of them."""
    span = high - low
    step = 10.0 ** math.floor(math.log10(span / most))
    while span / step > most - 1:
        step *= 2.5 if _leading(step) == 2 else 2
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, math.floor(high / step + 1e-9) + 1)]


def time_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Round times in seconds within [low, high]."""
    for step in (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800):
        if (high - low) / step <= most - 1:
            break
    else:
        step = 3600 * math.ceil((high - low) / 3600 / (most - 1))
    return [float(t) for t in range(math.ceil(low / step) * step, math.floor(high) + 1, step)]


def log_ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 of every decade; only powers of ten over more than three decades."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    digits = (1, 2, 5) if last - first <= 3 else (1,)
    ticks = [d * 10.0**e for e in range(first, last + 1) for d in digits]
    return [t for t in ticks if low * (1 - 1e-9) <= t <= high * (1 + 1e-9)]


def _leading(value: float) -> int:
    return round(value / 10.0 ** math.floor(math.log10(value) + 1e-9))


def line_chart(
    xs: Sequence[float],
    ys: Sequence[float],
    *,
    title: str,
    x_title: str,
    y_label: Label,
    timed: bool = False,
    log: bool = False,
) -> Markup:
    """A line chart, with the values of each point as a tooltip.

    Args:
        xs, ys: The points: finite values, at least one.
        y_label: The function that formats a y value for a tooltip.
        timed: Whether x is a time in seconds.
        log: Whether the y axis is logarithmic; ignored unless all values are positive.
    """
    log = log and min(ys) > 0
    x_low, x_high = _range(min(xs), max(xs), pad=0.0)
    y_low, y_high = (min(ys), max(ys)) if log else _range(min(ys), max(ys), pad=0.06)
    if log and y_high < 1.05 * y_low:
        y_low, y_high = y_low / 1.05, y_high * 1.05
    across = _scale(x_low, x_high, _LEFT, _WIDTH - _RIGHT)
    up = _scale(y_low, y_high, _HEIGHT - _BOTTOM, _TOP, log=log)
    x_label: Label = clock if timed else short
    x_ticks = time_ticks(x_low, x_high) if timed else linear_ticks(x_low, x_high)
    y_ticks = log_ticks(y_low, y_high) if log else linear_ticks(y_low, y_high, 5)
    if len(y_ticks) < 2:
        y_ticks = linear_ticks(y_low, y_high, 5)
    spots = [
        (across(x), up(y), f"{x_title} {clock(x) if timed else f'{x:,.0f}'}: {y_label(y)}")
        for x, y in zip(xs, ys, strict=True)
    ]
    return _chart(
        "line",
        title,
        x_title,
        xs=[(across(t), x_label(t)) for t in x_ticks],
        ys=[(up(t), short(t)) for t in y_ticks],
        spots=spots,
    )


@dataclass(frozen=True)
class ChartPoint:
    """A point of a trade-off chart.

    Attributes:
        seconds, error: Finite and positive values.
        name: The label; empty for a small point without a label.
        tip: The tooltip.
        colour: The index of a colour of the page.
    """

    seconds: float
    error: float
    name: str
    tip: str
    colour: int = 0


_COLOURS = ("--accent", "--test", "--train", "--bad", "--good")


def trade_off_chart(
    points: Sequence[ChartPoint], *, title: str, x_title: str, y_label: Label
) -> Markup:
    """Error against time, both logarithmic, with a line through the Pareto front of the named
    points.

    Args:
        points: The points, at least one.
        y_label: The function that formats an error for the axis.
    """
    xs, ys = [d.seconds for d in points], [d.error for d in points]
    x_low, x_high, y_low, y_high = min(xs) / 1.3, max(xs) * 1.3, min(ys) / 1.12, max(ys) * 1.12
    across = _scale(x_low, x_high, _LEFT, _WIDTH - _RIGHT, log=True)
    up = _scale(y_low, y_high, _HEIGHT - _BOTTOM, _TOP, log=True)
    steps = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 18_000, 36_000, 86_400)
    x_ticks: list[float] = [t for t in steps if x_low <= t <= x_high]
    if len(x_ticks) < 2:
        x_ticks = time_ticks(x_low, x_high)
    y_ticks = log_ticks(y_low, y_high)
    if len(y_ticks) < 3:
        y_ticks = [t for t in linear_ticks(y_low, y_high, 5) if t > 0]
    step = max(1, math.ceil(len(x_ticks) / 7))
    dots = []
    taken: list[tuple[float, float]] = []
    for point in sorted(points, key=lambda d: (bool(d.name), d.error)):
        x, y = across(point.seconds), up(point.error)
        dot = {"x": x, "y": y, "name": point.name, "tip": point.tip}
        dot["colour"] = _COLOURS[point.colour % len(_COLOURS)]
        if point.name:
            left = x + 16 + 7.5 * len(point.name) > _WIDTH
            heights = [y + d for d in (-6, 14, -20, 28)]
            taken.append((x, next((h for h in heights if _free(x, h, taken)), y)))
            dot["name_x"], dot["name_y"] = x + (-9 if left else 9), taken[-1][1]
            dot["anchor"] = "end" if left else "start"
        dots.append(dot)
    front = pareto_front([d for d in points if d.name])
    return _chart(
        "trade_off",
        title,
        x_title,
        xs=[(across(t), clock(t)) for t in x_ticks[::step]],
        ys=[(up(t), y_label(t)) for t in y_ticks],
        front=[(across(d.seconds), up(d.error)) for d in front],
        dots=dots,
    )


def _free(x: float, y: float, taken: Sequence[tuple[float, float]]) -> bool:
    """Whether a dot's name at height ``y`` keeps clear of the names that are placed."""
    return all(abs(x - other) > 90 or abs(y - height) > 11 for other, height in taken)


def pareto_front(points: Sequence[ChartPoint]) -> list[ChartPoint]:
    """The points that no other one beats in time and error, the quickest first."""
    front: list[ChartPoint] = []
    for dot in sorted(points, key=lambda d: (d.seconds, d.error)):
        if not front or dot.error < front[-1].error:
            front.append(dot)
    return front


def histogram(
    values: NDArray[Any], *, title: str, x_title: str, whole: bool = False, bins: int = 40
) -> Markup:
    """Counts of the values; those above the 99th percentile are in the last bar.

    Args:
        values: The finite values, at least one.
        whole: One bar a whole number (or several, where there are more than ``bins``).
    """
    top = float(np.percentile(values, 99))
    if whole:
        low = math.floor(values.min())
        width = max(math.ceil((math.ceil(top) - low + 1) / bins), 1)
        edges = np.arange(low, math.ceil(top) + width + 1, width, dtype=np.float64)
    else:
        low, high = _range(float(values.min()), top, pad=0.0)
        edges = np.linspace(low, high, bins + 1)
    counts, _ = np.histogram(np.minimum(values, (edges[-2] + edges[-1]) / 2), edges)
    over = bool(values.max() > edges[-1])
    across = _scale(float(edges[0]), float(edges[-1]), _LEFT, _WIDTH - _RIGHT)
    up = _scale(0.0, float(counts.max()) * 1.04, _HEIGHT - _BOTTOM, _TOP)
    bars = []
    for i, n in enumerate(counts):
        x, right = across(edges[i]) + 0.5, across(edges[i + 1]) - 0.5
        last = over and i == len(counts) - 1
        if whole:
            name = short(edges[i]) if edges[i + 1] - edges[i] == 1 else ""
            name = name or f"{short(edges[i])} to {short(edges[i + 1] - 1)}"
        else:
            name = f"{short(edges[i])} to {short(edges[i + 1])}"
        name = f"{short(edges[i])} or more" if last else name
        bars.append((x, up(n), max(right - x, 0.5), f"{name}: {n:,}"))
    ticks = linear_ticks(float(edges[0]), float(edges[-1]))
    # The label of an integer is at the middle of its bar.
    half = 0.5 if whole and edges[1] - edges[0] == 1 else 0.0
    ticks = [t for t in ticks if t == round(t) and t < edges[-1]] if whole else ticks
    median = float(np.median(values))
    y_ticks = [t for t in linear_ticks(0.0, float(counts.max()) * 1.04, 5) if t == round(t)]
    return _chart(
        "histogram",
        title,
        x_title,
        xs=[(across(t + half), short(t)) for t in ticks],
        ys=[(up(t), short(t)) for t in y_ticks],
        bars=bars,
        median=across(min(median + half, float(edges[-1]))),
    )


def _range(low: float, high: float, pad: float) -> tuple[float, float]:
    """The range extended by ``pad`` on both sides; never empty."""
    span = high - low
    if span <= 1e-9 * max(abs(low), abs(high), 1e-9):
        span = max(abs(high), 1.0)
        return low - span / 2, high + span / 2
    return low - pad * span, high + pad * span


def _scale(
    low: float, high: float, start: float, stop: float, *, log: bool = False
) -> Callable[[float], float]:
    if log:
        linear = _scale(math.log(low), math.log(high), start, stop)
        return lambda value: linear(math.log(value))
    return lambda value: start + (value - low) / (high - low) * (stop - start)


def _chart(kind: str, title: str, x_title: str, **values: Any) -> Markup:
    """Draw a chart with the template of its kind."""
    return render(
        f"charts/{kind}.html.jinja",
        title=title,
        x_title=x_title,
        width=_WIDTH,
        height=_HEIGHT,
        left=_LEFT,
        right=_WIDTH - _RIGHT,
        top=_TOP,
        base=_HEIGHT - _BOTTOM,
        **values,
    )
