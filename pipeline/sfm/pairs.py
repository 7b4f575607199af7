"""Selection of image pairs to match. Pairs are (i, j) indices with i < j, sorted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from pipeline.runtime.progress import Progress

Pair = tuple[int, int]

# Retrieval compares the descriptors of the largest scales only.
RETRIEVAL_DESCRIPTORS = 300
RETRIEVAL_RATIO = 0.85
# Upper bound on photographs times descriptors: more photographs use fewer descriptors each.
RETRIEVAL_BUDGET = 300 * RETRIEVAL_DESCRIPTORS
RETRIEVAL_MIN_DESCRIPTORS = 64
# Unrelated photographs have a few mutual matches by chance; lower scores are ignored.
RETRIEVAL_MIN_SCORE = 4
# Number of photographs compared with one at a time: 300 x 300 distances each, 20 MB in all.
RETRIEVAL_BATCH = 64
DESCRIPTOR_SIZE = 128
# Larger than the squared distance of any two descriptors (2 * 512^2), exact in float32.
FAR = 2.0**22

# Number of loop closure candidates of each photograph of a sequence.
LOOP_CLOSURES = 3


def exhaustive_pairs(count: int) -> list[Pair]:
    """All pairs of ``count`` photographs."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def sequential_pairs(count: int, overlap: int) -> list[Pair]:
    """Each photograph with the next ``overlap``, and with the ones 2, 4, 8, ... 2^overlap after it
    (COLMAP's quadratic overlap, which bridges blurred or occluded stretches)."""
    steps = set(range(1, overlap + 1))
    power = 1
    while power < count and power <= 2**overlap:
        steps.add(power)
        power *= 2
    return [(i, i + step) for i in range(count) for step in sorted(steps) if i + step < count]


def spatial_pairs(gps: Sequence[tuple[float, float, float] | None], neighbours: int) -> list[Pair]:
    """Each photograph with its ``neighbours`` nearest ones by horizontal distance.

    Altitudes are ignored: GPS measures them inaccurately. Photographs without a position are in no
    pair.

    Args:
        gps: latitude and longitude in degrees, altitude in metres; None without a position.
    """
    known = [i for i, position in enumerate(gps) if position is not None]
    if len(known) < 2:
        return []
    degrees = np.array([gps[i][:2] for i in known])  # type: ignore[index]
    # Equirectangular projection around the mean latitude: accurate enough to find neighbours.
    east = degrees[:, 1] * np.cos(np.radians(degrees[:, 0].mean()))
    metres = np.column_stack([east, degrees[:, 0]]) * 111_320.0
    _, nearest = cKDTree(metres).query(metres, k=min(neighbours + 1, len(known)))
    return _unique((known[a], known[b]) for a, row in enumerate(nearest) for b in row)


def proximity_pairs(
    centres: NDArray[np.float64], directions: NDArray[np.float64], neighbours: int
) -> list[Pair]:
    """Each camera with its ``neighbours`` nearest ones in position and viewing direction, up to 75
    degrees apart.

    Args:
        centres, directions: (N, 3) in world coordinates; directions are unit vectors along the
            optical axes.
    """
    count = len(centres)
    if count < 2:
        return []
    distance = cdist(centres, centres)
    angle = np.arccos(np.clip(directions @ directions.T, -1, 1))
    # One radian has the weight of the median distance between cameras.
    unit = float(np.median(distance[np.triu_indices(count, 1)]))
    cost = distance / max(unit, 1e-12) + angle
    cost[angle > np.radians(75)] = np.inf
    np.fill_diagonal(cost, np.inf)
    k = min(neighbours, count - 1)
    nearest = np.argsort(cost, axis=1, kind="stable")[:, :k]
    return _unique(
        (i, int(j)) for i, row in enumerate(nearest) for j in row if np.isfinite(cost[i, j])
    )


def retrieval_pairs(descriptors: Sequence[NDArray[np.uint8]], neighbours: int) -> list[Pair]:
    """Each photograph with the ``neighbours`` most similar ones by ``retrieval_scores``, and the
    pairs of the maximum spanning tree of the scores, which keep the view graph connected.

    Args:
        descriptors: for each photograph (F, 128) uint8, largest scale first.
    """
    score = retrieval_scores(descriptors)
    return _unique([*_best(score, neighbours), *_spanning_tree(score)])


def loop_closure_pairs(descriptors: Sequence[NDArray[np.uint8]], overlap: int) -> list[Pair]:
    """Each photograph with the most similar ones (by ``retrieval_scores``) that are more than
    ``overlap`` away in the sequence."""
    score = retrieval_scores(descriptors)
    index = np.arange(len(score))
    score[np.abs(index[:, None] - index[None]) <= overlap] = 0
    return _unique(_best(score, LOOP_CLOSURES))


def retrieval_scores(descriptors: Sequence[NDArray[np.uint8]]) -> NDArray[np.int64]:
    """(N, N) symmetric number of mutual nearest neighbours that pass the ratio test among the
    largest-scale descriptors of two photographs.

    Sums of products of bytes are exact in float32 (below 2^24), so the scores do not depend on the
    BLAS library or its threads.
    """
    count = len(descriptors)
    keep = RETRIEVAL_BUDGET // max(count, 1)
    keep = max(RETRIEVAL_MIN_DESCRIPTORS, min(RETRIEVAL_DESCRIPTORS, keep))
    # Photographs with fewer descriptors are padded with ones that are never nearest.
    table = np.zeros((count, keep, DESCRIPTOR_SIZE), np.float32)
    norms = np.full((count, keep), FAR, np.float32)
    for i, found in enumerate(descriptors):
        table[i, : len(found[:keep])] = found[:keep]
        norms[i, : len(found[:keep])] = (table[i, : len(found[:keep])] ** 2).sum(axis=1)
    score = np.zeros((count, count), np.int64)
    progress = Progress("selecting pairs", count, "photographs")
    for i in range(count):
        own = min(len(descriptors[i]), keep)
        for start in range(i + 1, count, RETRIEVAL_BATCH):
            stop = min(start + RETRIEVAL_BATCH, count)
            others = table[start:stop].reshape(-1, DESCRIPTOR_SIZE)
            squared = -2 * (table[i, :own] @ others.T)
            squared += norms[i, :own, None] + norms[start:stop].reshape(-1)
            score[i, start:stop] = _mutual(squared.reshape(own, stop - start, keep))
        score[i:, i] = score[i, i:]
        progress.advance()
    return score


def _mutual(squared: NDArray[np.float32]) -> NDArray[np.int64]:
    """(M,) number of mutual nearest neighbours that pass the ratio test.

    Args:
        squared: (F, M, G) squared distances of F descriptors to the G descriptors of each of M
            photographs; overwritten.
    """
    if squared.shape[0] == 0:
        return np.zeros(squared.shape[1], np.int64)
    nearest = squared.argmin(axis=2)
    back = np.take_along_axis(squared.argmin(axis=0), nearest.T, axis=1).T
    mutual = back == np.arange(len(squared))[:, None]
    best = np.take_along_axis(squared, nearest[..., None], axis=2)[..., 0]
    np.put_along_axis(squared, nearest[..., None], np.float32(2 * FAR), axis=2)
    accepted = best < RETRIEVAL_RATIO**2 * squared.min(axis=2)
    return (mutual & accepted & (best < FAR / 2)).sum(axis=0)


def _best(score: NDArray[np.int64], neighbours: int) -> list[Pair]:
    """Each photograph with the ones of the highest scores."""
    ranked = np.argsort(-score, axis=1, kind="stable")[:, :neighbours]
    return [
        (i, int(j))
        for i, row in enumerate(ranked)
        for j in row
        if score[i, j] >= RETRIEVAL_MIN_SCORE
    ]


def _spanning_tree(score: NDArray[np.int64]) -> list[Pair]:
    # A minimum spanning tree of inverse scores; zero means no edge.
    weight = np.where(score >= RETRIEVAL_MIN_SCORE, 1.0 / np.maximum(score, 1), 0.0)
    tree = minimum_spanning_tree(csr_matrix(np.triu(weight))).tocoo()
    return [(int(i), int(j)) for i, j in zip(tree.row, tree.col, strict=True)]


def _unique(pairs: object) -> list[Pair]:
    ordered = {(min(int(a), int(b)), max(int(a), int(b))) for a, b in pairs}  # type: ignore
    return sorted((a, b) for a, b in ordered if a != b)
