"""A second try for the photographs that mapping left out.

COLMAP's mapper asks for 30 matches between a photograph and the model, because a wrong photograph
bends a small model. A finished model does not change: fewer are asked for, and what is registered
must agree with its own pairs.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import pycolmap

from pipeline.sfm.consistency import pair_agrees
from pipeline.sfm.evidence import read_verified_pairs
from pipeline.sfm.mappers import continue_mapping
from pipeline.sfm.model_views import ModelView, Pairs, read_views

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
    registered = set(model.reg_image_ids())
    with pycolmap.Database.open(database) as opened:
        pairs = read_verified_pairs(opened)
        names = {image.image_id: image.name for image in opened.read_all_images()}
    if not any(
        len(_pairs_of(i, pairs, registered)) >= MIN_PAIRS for i in names.keys() - registered
    ):
        return model, []
    with tempfile.TemporaryDirectory(dir=database.parent) as folder:
        found = continue_mapping(model, database, Path(folder), seed)
    added = sorted(set(found.reg_image_ids()) - registered)
    with pycolmap.Database.open(database) as opened:
        views = read_views(found, opened)
    # One that is wrong may have carried others: each is compared with the model alone.
    right = [i for i in added if _is_right(i, views, _pairs_of(i, pairs, registered))]
    for image_id in added:
        if image_id not in right:
            found.deregister_frame(found.image(image_id).frame_id)
    return (found, [names[i] for i in right]) if right else (model, [])


def _pairs_of(image_id: int, pairs: Pairs, others: set[int]) -> Pairs:
    """The pairs of a photograph with others."""
    return {
        pair: matches
        for pair, matches in pairs.items()
        if image_id in pair and others & (set(pair) - {image_id})
    }


def _is_right(image_id: int, views: dict[int, ModelView], pairs: Pairs) -> bool:
    agree = [pair_agrees(views[a], views[b], matches) for (a, b), matches in pairs.items()]
    enough = sum(agree) >= max(MIN_PAIRS, MIN_AGREEING_PAIRS * len(agree))
    return enough and len(views[image_id].points) >= MIN_POINTS
