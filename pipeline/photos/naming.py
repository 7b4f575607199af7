"""Names of pictures that are written anew in another format."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import PurePosixPath


def rename(suffixes: Mapping[str, str]) -> dict[str, str]:
    """New names, one each: the suffix is replaced, or appended where two would become the same.

    Args:
        suffixes: new suffix (".png") of every name; "" leaves a name as it is.
    """
    short = {
        name: str(PurePosixPath(name).with_suffix(suffix)) if suffix else name
        for name, suffix in suffixes.items()
    }
    count = Counter(short.values())
    return {
        name: short[name] if count[short[name]] == 1 or not suffix else name + suffix
        for name, suffix in suffixes.items()
    }
