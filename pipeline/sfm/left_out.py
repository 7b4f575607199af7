"""A second try for the photographs that mapping left out.

COLMAP's mapper asks for 30 matches between a photograph and the model, because a wrong photograph
bends a small model. A finished model does not change: fewer are asked for, and what is registered
must agree with its own pairs. Photographs without such pairs are placed by their matches with all
photographs of the model together.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Set
from pathlib import Path

import pycolmap

from pipeline.sfm.consistency import pair_agrees
from pipeline.sfm.evidence import read_verified_pairs
from pipeline.sfm.mappers import continue_mapping
from pipeline.sfm.model_views import ModelView, Pairs, read_views
from pipeline.sfm.resection import resect

#: Smallest number of pairs with registered photographs that agree with the pose.
MIN_PAIRS = 2
#: Smallest share of the pairs with registered photographs that agree with the pose.
MIN_AGREEING_PAIRS = 0.75
#: Smallest number of points of the model that the photograph observes.
MIN_POINTS = 20


def register_left_out(
    model: pycolmap.Reconstruction, database: Path, seed: int
) -> tuple[pycolmap.Reconstruction, list[str]]:
    """Register photographs that are not in a model.

    Args:
        model: The model, whose poses and cameras stay as they are.
        database: The database that it was mapped from; not changed.

    Returns:
        The model with more photographs, and their names; without any, the same model.
    """
    with pycolmap.Database.open(database) as opened:
        pairs = read_verified_pairs(opened)
        names = {image.image_id: image.name for image in opened.read_all_images()}
    more, grown = model, True
    while grown:
        by_pairs = _by_pairs(more, database, pairs, names.keys() - more.reg_image_ids(), seed)
        more = by_pairs or more
        resected = _by_all_matches(more, database, pairs, names.keys() - more.reg_image_ids())
        more = resected or more
        grown = resected is not None
    return more, [names[i] for i in sorted(set(more.reg_image_ids()) - set(model.reg_image_ids()))]


def _by_pairs(
    model: pycolmap.Reconstruction, database: Path, pairs: Pairs, missing: Set[int], seed: int
) -> pycolmap.Reconstruction | None:
    """The model with further photographs, by verified matches; None without any."""
    registered = set(model.reg_image_ids())
    if not any(len(_pairs_of(i, pairs, registered)) >= MIN_PAIRS for i in missing):
        return None
    with tempfile.TemporaryDirectory(dir=database.parent) as folder:
        found = continue_mapping(model, database, Path(folder), seed)
    return _checked(found, model, database, pairs, _is_right)


def _by_all_matches(
    model: pycolmap.Reconstruction, database: Path, pairs: Pairs, missing: Set[int]
) -> pycolmap.Reconstruction | None:
    """The model with further photographs, by the matches with all of its photographs together;
    None without any."""
    found, resected = resect(model, database, set(missing))
    return _checked(found, model, database, pairs, _is_not_contradicted) if resected else None


def _checked(
    found: pycolmap.Reconstruction,
    model: pycolmap.Reconstruction,
    database: Path,
    pairs: Pairs,
    check: Callable[[int, dict[int, ModelView], Pairs], bool],
) -> pycolmap.Reconstruction | None:
    """A model with more photographs, without those that fail a check; None if all do."""
    registered = set(model.reg_image_ids())
    added = sorted(set(found.reg_image_ids()) - registered)
    with pycolmap.Database.open(database) as opened:
        views = read_views(found, opened)
    # One that is wrong may have carried others: each is compared with the model alone.
    right = [i for i in added if check(i, views, _pairs_of(i, pairs, registered))]
    for image_id in added:
        if image_id not in right:
            found.deregister_frame(found.image(image_id).frame_id)
    return found if right else None


def _pairs_of(image_id: int, pairs: Pairs, others: set[int]) -> Pairs:
    """The pairs of a photograph with others."""
    return {
        pair: matches
        for pair, matches in pairs.items()
        if image_id in pair and others & (set(pair) - {image_id})
    }


def _is_right(image_id: int, views: dict[int, ModelView], pairs: Pairs) -> bool:
    agreeing = _agreeing(views, pairs)
    return (
        _is_not_contradicted(image_id, views, pairs)
        and agreeing >= MIN_PAIRS
        and len(views[image_id].points) >= MIN_POINTS
    )


def _is_not_contradicted(_: int, views: dict[int, ModelView], pairs: Pairs) -> bool:
    return _agreeing(views, pairs) >= MIN_AGREEING_PAIRS * len(pairs)


def _agreeing(views: dict[int, ModelView], pairs: Pairs) -> int:
    return sum(pair_agrees(views[a], views[b], matches) for (a, b), matches in pairs.items())
