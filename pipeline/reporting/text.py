"""Formats values for display."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.runtime import text

MISSING = "n/a"


def fixed(value: float | None, digits: int) -> str:
    """``digits`` decimals, or n/a for None and values that are not finite."""
    if value is None or not math.isfinite(value):
        return MISSING
    return f"{value:,.{digits}f}"


def count(value: float | None) -> str:
    return fixed(value, 0)


def duration(seconds: float | None) -> str:
    """As ``pipeline.runtime.text.duration``, or n/a for None and values that are not finite."""
    if seconds is None or not math.isfinite(seconds):
        return MISSING
    return text.duration(seconds)


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
