"""Formats values for display."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

MISSING = "n/a"


def fixed(value: float | None, digits: int) -> str:
    """``digits`` decimals, or n/a for None and values that are not finite."""
    if value is None or not math.isfinite(value):
        return MISSING
    return f"{value:,.{digits}f}"


def count(value: float | None) -> str:
    return fixed(value, 0)


def duration(seconds: float | None) -> str:
    """0.42 s, 7.1 s, 3 min 20 s, 2 h 05 min."""
    if seconds is None or not math.isfinite(seconds):
        return MISSING
    if seconds < 60:
        return f"{seconds:.2f} s" if seconds < 1 else f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def plain(value: Any) -> str:
    """Any JSON value on one line."""
    match value:
        case None:
            return MISSING
        case bool():
            return "yes" if value else "no"
        case int():
            return f"{value:,}"
        case float():
            return f"{value:.6g}" if math.isfinite(value) else MISSING
        case str():
            return value
        case Mapping():
            return ", ".join(f"{name}: {plain(v)}" for name, v in value.items()) or "none"
        case Sequence():
            return ", ".join(plain(v) for v in value) or "none"
        case _:
            return str(value)
