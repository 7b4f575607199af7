"""Leaves out pairs that match although they show different parts that look alike."""

from __future__ import annotations

import shutil
from collections.abc import Collection
from pathlib import Path

import pycolmap

from pipeline.sfm.consistency import pair_agrees
from pipeline.sfm.distinctive import distinctive_pairs
from pipeline.sfm.evidence import read_verified_pairs
from pipeline.sfm.mappers import run_mapper
from pipeline.sfm.model_views import read_views


def leave_out_look_alikes(
    source: Path, neighbours: Collection[tuple[str, str]], total: int, seed: int, target: Path
) -> bool:
    """Copy a database without the pairs that contradict the model of its distinctive pairs.

    The distinctive pairs are mapped alone. They are kept, and those of the other pairs that agree
    with their model. Pairs of photographs outside the model are left out.

    Args:
        neighbours: The names of neighbours in a sequence, whose pairs are kept too.
        total: The number of photographs.

    Returns:
        Whether ``target`` lacks pairs of ``source`` and was written.
    """
    with pycolmap.Database.open(source) as database:
        pairs = read_verified_pairs(database)
        names = {image.image_id: image.name for image in database.read_all_images()}
    kept = distinctive_pairs(pairs)
    kept |= {(a, b) for a, b in pairs if (names[a], names[b]) in neighbours}
    _keep_pairs(source, kept, target)
    models = run_mapper("incremental", target, total, seed)
    if not models:
        return False
    with pycolmap.Database.open(source) as database:
        views = read_views(models[0], database)
    for pair, matches in pairs.items():
        if set(pair) <= set(views) and pair_agrees(views[pair[0]], views[pair[1]], matches):
            kept.add(pair)
    _keep_pairs(source, kept, target)
    return len(kept) < len(pairs)


def _keep_pairs(source: Path, kept: Collection[tuple[int, int]], target: Path) -> None:
    """Copy a database with the verified matches of these pairs alone."""
    shutil.copyfile(source, target)
    with pycolmap.Database.open(target) as database, pycolmap.DatabaseTransaction(database):
        for pair in read_verified_pairs(database):
            if pair not in kept:
                database.delete_inlier_matches(*pair)
