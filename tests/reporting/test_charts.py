"""Charts are readable for any numbers."""

import re

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.reporting.charts import (
    ChartPoint,
    clock,
    histogram,
    line_chart,
    linear_ticks,
    log_ticks,
    short,
    time_ticks,
    trade_off_chart,
)

spread = st.tuples(st.floats(-1e6, 1e6), st.floats(1e-4, 1e7))


@settings(max_examples=200, derandomize=True, deadline=None)
@given(spread, st.integers(3, 8))
def test_linear_ticks_are_few_round_and_inside(spread, most) -> None:
    low, high = spread[0], spread[0] + spread[1]
    ticks = linear_ticks(low, high, most)
    assert len(ticks) <= most
    slack = 1e-6 * (high - low)
    assert all(low - slack <= t <= high + slack for t in ticks)
    if len(ticks) > 1:
        digits = f"{ticks[1] - ticks[0]:.2e}"[0]
        assert digits in "125"


def test_ticks_by_hand() -> None:
    assert linear_ticks(0, 7000) == [0, 2000, 4000, 6000]
    assert linear_ticks(12.3, 31.1, 5) == [15, 20, 25, 30]
    assert log_ticks(0.02, 0.3) == [0.02, 0.05, 0.1, 0.2]
    assert time_ticks(0, 700) == [0, 300, 600]
    assert time_ticks(0, 40_000) == [0, 10800, 21600, 32400]
    assert [short(v) for v in (0.25, 1500, 2_000_000)] == ["0.25", "1.5k", "2M"]
    assert [clock(v) for v in (90, 5400)] == ["1:30", "1:30:00"]


numbers = st.floats(-1e9, 1e9, allow_subnormal=False)


@settings(max_examples=60, derandomize=True, deadline=None)
@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=20), st.booleans())
def test_a_line_stays_inside_its_frame(points, log) -> None:
    xs, ys = zip(*sorted(points), strict=True)
    svg = line_chart(xs, ys, title="t", x_title="x", y_label=str, log=log)
    path = re.search(r'class="line" points="([^"]*)"', svg)
    assert path is not None
    spots = np.array([[float(v) for v in spot.split(",")] for spot in path[1].split()])
    assert spots.shape == (len(points), 2)
    assert spots.min() >= 0 and spots[:, 0].max() <= 440 and spots[:, 1].max() <= 250
    assert "nan" not in svg and "inf" not in svg.replace("info", "")


def counts(svg: str) -> list[int]:
    return [int(n.replace(",", "")) for n in re.findall(r"<title>[^<]*: ([\d,]+)</title>", svg)]


@settings(max_examples=60, derandomize=True, deadline=None)
@given(st.lists(st.floats(0, 1e6, allow_subnormal=False), min_size=1, max_size=50), st.booleans())
def test_a_histogram_counts_every_value(values, whole) -> None:
    array = np.floor(values) if whole else np.array(values)
    assert sum(counts(histogram(array, title="t", x_title="x", whole=whole))) == len(values)


def test_whole_numbers_have_a_bar_each_and_the_tail_is_named() -> None:
    lengths = np.array([2] * 60 + [3] * 30 + [4] * 20 + [900])
    svg = histogram(lengths, title="t", x_title="x", whole=True)
    assert "<title>2: 60</title>" in svg and "<title>3: 30</title>" in svg
    assert "<title>4 or more: 21</title>" in svg


positive = st.floats(1e-3, 1e6)


@settings(max_examples=100, derandomize=True, deadline=None)
@given(st.lists(st.tuples(positive, positive), min_size=1, max_size=12))
def test_any_time_and_error_make_a_trade_off(pairs) -> None:
    """Including a single run between two round times."""
    dots = [ChartPoint(seconds, error, "a", "tip") for seconds, error in pairs]
    svg = trade_off_chart(dots, title="t", x_title="x", y_label=str)
    assert "nan" not in svg
    assert trade_off_chart([ChartPoint(196.0, 0.3, "a", "")], title="t", x_title="x", y_label=str)
