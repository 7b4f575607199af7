"""The plan's sentences about the colour spaces of photographs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from pipeline.io.photofile import FileFacts
from pipeline.scene.manifest import Photo


def converted_colours(photos: Sequence[Photo]) -> list[str]:
    """A decision for each colour space that is converted to sRGB."""
    counts = Counter(photo.colours for photo in photos if photo.colours)
    return [
        f"{count} of {len(photos)} photographs are {name}: converted to sRGB"
        for name, count in sorted(counts.items())
    ]


def unread_colours(facts: Mapping[str, FileFacts]) -> list[str]:
    """A warning for each reason why colours that are not sRGB are used as if they were."""
    first: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for name in sorted(facts):
        if fault := facts[name].colours_fault:
            first.setdefault(fault, name)
            counts[fault] += 1
    return [
        f"the colours of {counts[fault]} of {len(facts)} photographs cannot be converted and are "
        f"used as sRGB: {fault} (first: {first[fault]}); export them as sRGB"
        for fault in sorted(first)
    ]
