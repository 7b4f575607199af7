"""Names of files that messages, JSON and command lines can hold."""

from __future__ import annotations

import unicodedata

# Control characters, surrogates (bytes that are not UTF-8), separators of lines and paragraphs.
_REFUSED = frozenset({"Cc", "Cs", "Zl", "Zp"})


def is_plain(name: str) -> bool:
    """Whether a name is UTF-8 on one line. Spaces of any kind are allowed: macOS puts a narrow
    no-break space into the names of screenshots."""
    return all(unicodedata.category(c) not in _REFUSED for c in name)
