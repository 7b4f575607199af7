"""File names of images that are converted to another format."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import PurePosixPath


def rename(suffixes: Mapping[str, str]) -> dict[str, str]:
    """The new, distinct name of each image. The suffix is replaced, or appended if two names would
    become equal.

    Args:
        suffixes: The new suffix (".png") of each name; "" for a name that does not change.
    """
    replaced = {
        name: str(PurePosixPath(name).with_suffix(suffix)) if suffix else name
        for name, suffix in suffixes.items()
    }
    count = Counter(replaced.values())
    return {
        name: replaced[name] if count[replaced[name]] == 1 or not suffix else name + suffix
        for name, suffix in suffixes.items()
    }
