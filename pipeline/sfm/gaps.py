"""What to photograph so that the parts of a scene can be joined."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import pycolmap

from pipeline.sfm.components import Component
from pipeline.sfm.counters import Gap

# Smallest number of matches of a lone photograph with one that is placed. Unrelated photographs
# have fewer by chance.
MIN_MATCHES = 25
# Largest number of lone photographs that are listed.
MAX_LONE = 5


def find_gaps(database: Path, components: Sequence[Component], used: int) -> list[Gap]:
    """For each component that is not used, and for photographs in none, the pair with most matches
    between it and the component that is used. All components are listed; of the lone photographs,
    those with most matches.

    Args:
        database: The matches, whether verified or not.
        used: The index of the component that is used.
    """
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        ids, counts = opened.read_num_matches()
        verified = dict(zip(*opened.read_two_view_geometry_num_inliers(), strict=True))
    placed = components[used].photographs
    found = []
    for pair_id, count in zip(ids, counts, strict=True):
        pair = pycolmap.pair_id_to_image_pair(pair_id)
        for here, there in (pair, pair[::-1]):
            if here in placed and there not in placed:
                found.append((verified.get(pair_id, 0), count, here, there))
    found.sort(key=lambda row: (-row[0], -row[1], names[row[2]], names[row[3]]))
    gaps, known = [], set(placed)
    for index, component in enumerate(components):
        known |= component.photographs
        if index != used and (row := _first(found, component.photographs)):
            gaps.append(
                Gap(placed=names[row[2]], other=names[row[3]], component=index, matches=row[1])
            )
    for lone in sorted(names.keys() - known):
        row = _first(found, {lone})
        if row and row[1] >= MIN_MATCHES:
            gaps.append(
                Gap(placed=names[row[2]], other=names[lone], component=None, matches=row[1])
            )
    joined = [gap for gap in gaps if gap.component is not None]
    alone = [gap for gap in gaps if gap.component is None]
    return joined + sorted(alone, key=lambda gap: -gap.matches)[:MAX_LONE]


def _first(
    rows: Iterable[tuple[int, int, int, int]], images: set[int]
) -> tuple[int, int, int, int] | None:
    """The first row of a photograph in ``images``."""
    return next((row for row in rows if row[3] in images), None)
