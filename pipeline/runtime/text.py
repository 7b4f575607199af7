"""Text that messages hold: which names are plain, and values in a bounded length."""

from __future__ import annotations

import reprlib
import unicodedata
from typing import Any

# Control characters, surrogates (bytes that are not UTF-8), separators of lines and paragraphs.
_REFUSED = frozenset({"Cc", "Cs", "Zl", "Zp"})
# The largest number of numbers that a lens has.
_REPR = reprlib.Repr()
_REPR.maxlist = _REPR.maxtuple = 14


def is_plain(name: str) -> bool:
    """Whether a name is UTF-8 on one line. Spaces of any kind are allowed: macOS puts a narrow
    no-break space into the names of screenshots."""
    return all(unicodedata.category(c) not in _REFUSED for c in name)


def shown(value: Any, limit: int = 60) -> str:
    """A value of a file as messages quote it: Python's notation on one line, shortened to about
    ``limit`` characters, in bounded time whatever the value refers to."""
    try:
        if isinstance(value, str):
            text = repr(value[: limit + 1])
            return text if len(value) <= limit else f"{text[: limit + 1]}..."
        # numpy's numbers and small arrays are shown as Python's.
        if hasattr(value, "tolist") and getattr(value, "size", 0) <= 100:
            value = value.tolist()
        return shortened(_REPR.repr(value), limit)
    except ValueError:  # Python does not print integers of thousands of digits.
        return "a number of thousands of digits"


def counted(count: int, noun: str) -> str:
    """A number with its noun, such as "1 photograph" or "2,461 photographs"."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def duration(seconds: float) -> str:
    """A duration such as "4.2 s", "37 s", "12 min 5 s" or "3 h 20 min"."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, of_hour = divmod(minutes, 60)
    if hours:
        return f"{hours} h {of_hour} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def shortened(text: str, limit: int = 100) -> str:
    """A text without more than its first ``limit`` characters."""
    return text if len(text) <= limit else f"{text[:limit]}..."


def without_middle(text: str, limit: int) -> str:
    """A text of at most ``limit`` characters: its start and its end, "..." for what is between."""
    if len(text) <= limit:
        return text
    end = limit // 3
    return f"{text[: limit - end - 3]}...{text[-end:]}"
