"""Pairs of photographs that share what few other photographs show.

A keypoint of a repeated part matches many photographs, one of the surroundings only those that are
really near. With weights that fall with the number of photographs that a keypoint matches, near
photographs share most of their weight, and photographs of different equal parts share little of it
(Kataria et al. 2020, *Improving Structure from Motion with Reliable Resectioning*).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.sfm.model_views import Pairs

# A pair is distinctive if it is among so many best pairs of both its photographs.
BEST_PAIRS = 2
# The weight of a keypoint falls with this power of the number of photographs that it matches.
RARITY_POWER = 2


def distinctive_pairs(pairs: Pairs) -> set[tuple[int, int]]:
    """The pairs that share what few other photographs show.

    Args:
        pairs: The verified matches of all pairs.
    """
    share = _shared_weight(pairs)
    best: dict[int, list[tuple[int, int]]] = {}
    for pair in sorted(share, key=lambda pair: (-share[pair], pair)):
        for image in pair:
            best.setdefault(image, []).append(pair)
    return {pair for pair in share if all(pair in best[image][:BEST_PAIRS] for image in pair)}


def _shared_weight(pairs: Pairs) -> dict[tuple[int, int], float]:
    """The share of the weight of a photograph's keypoints that a pair matches, the mean of both."""
    size: dict[int, int] = {}
    for pair, matches in pairs.items():
        for image, column in zip(pair, matches.T, strict=True):
            size[image] = max(size.get(image, 0), int(column.max()) + 1)
    weight: dict[int, NDArray[np.float64]] = {i: np.zeros(count) for i, count in size.items()}
    for pair, matches in pairs.items():
        for image, column in zip(pair, matches.T, strict=True):
            weight[image][column] += 1
    for image, count in weight.items():
        rare = np.where(count > 0, 1 / np.maximum(count, 1) ** RARITY_POWER, 0)
        weight[image] = rare / rare.sum()
    return {
        pair: float(sum(weight[i][c].sum() for i, c in zip(pair, matches.T, strict=True)) / 2)
        for pair, matches in pairs.items()
    }
