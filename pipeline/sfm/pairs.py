"""Selection of image pairs to match. Pairs are (i, j) indices with i < j, sorted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from pipeline.runtime.progress import Progress

Pair = tuple[int, int]
Descriptors = Sequence[NDArray[np.uint8]]
"""For each photograph (F, 128), largest scale first."""

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
# Number of scored pairs in memory, 24 bytes each, before all but the strongest are left out.
MAX_SCORED_PAIRS = 300_000
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


def spatial_pairs(
    gps: Sequence[tuple[float, float, float | None] | None], neighbours: int
) -> list[Pair]:
    """Each photograph with its ``neighbours`` nearest ones by horizontal distance.

    Altitudes are ignored: GPS measures them inaccurately. Photographs without a position are in no
    pair.

    Args:
        gps: The latitude and longitude in degrees, altitude in metres or None; None without a
            position.
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


def retrieval_pairs(descriptors: Descriptors, neighbours: int) -> list[Pair]:
    """Each photograph with the ``neighbours`` most similar ones by ``retrieval_scores``, and the
    pairs of the maximum spanning tree of the scores, which keep the view graph connected."""
    return _similar(descriptors, neighbours, tree=True)


def loop_closure_pairs(descriptors: Descriptors, overlap: int) -> list[Pair]:
    """Each photograph with the most similar ones (by ``retrieval_scores``) that are more than
    ``overlap`` away in the sequence."""
    return _similar(descriptors, LOOP_CLOSURES, overlap)


def descriptors_per_photo(count: int) -> int:
    """Number of descriptors that retrieval compares of each of ``count`` photographs."""
    keep = RETRIEVAL_BUDGET // max(count, 1)
    return max(RETRIEVAL_MIN_DESCRIPTORS, min(RETRIEVAL_DESCRIPTORS, keep))


def retrieval_scores(descriptors: Descriptors) -> Iterator[tuple[int, int, NDArray[np.int64]]]:
    """The number of mutual nearest neighbours that pass the ratio test among the largest-scale
    descriptors of two photographs, for all pairs.

    Sums of products of bytes are exact in float32 (below 2^24), so the scores do not depend on the
    BLAS library or its threads.

    Yields:
        Photograph ``i``, a later photograph ``j``, and the scores of ``i`` with ``j``, ``j + 1``,
        and so on.
    """
    count = len(descriptors)
    keep = descriptors_per_photo(count)
    progress = Progress("selecting pairs", count, "photographs")
    for start in range(0, count, RETRIEVAL_BATCH):
        stop = min(start + RETRIEVAL_BATCH, count)
        # Photographs with fewer descriptors are padded with ones that are never nearest.
        table = np.zeros((stop - start, keep, DESCRIPTOR_SIZE), np.float32)
        norms = np.full((stop - start, keep), FAR, np.float32)
        for row, found in enumerate(descriptors[start:stop]):
            table[row, : len(found[:keep])] = found[:keep]
            norms[row, : len(found[:keep])] = _norms(found[:keep].astype(np.float32))
        for i in range(stop - 1):
            own = descriptors[i][:keep].astype(np.float32)
            first = max(i + 1, start)
            others = table[first - start :].reshape(-1, DESCRIPTOR_SIZE)
            squared = -2 * (own @ others.T)
            squared += _norms(own)[:, None] + norms[first - start :].reshape(-1)
            yield i, first, _mutual(squared.reshape(len(own), stop - first, keep))
        progress.advance(stop - start)


def _norms(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    return (descriptors**2).sum(axis=1)


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


def _similar(
    descriptors: Descriptors, neighbours: int, overlap: int = 0, *, tree: bool = False
) -> list[Pair]:
    """Each photograph with those of the highest scores that are more than ``overlap`` away, and the
    pairs of the spanning tree. The memory is linear in the number of photographs."""
    count = len(descriptors)
    kept, found, num_found = np.zeros((0, 3), np.int64), [], 0
    for i, first, scores in retrieval_scores(descriptors):
        j = np.arange(first, first + len(scores))
        accepted = (scores >= RETRIEVAL_MIN_SCORE) & (j - i > overlap)
        j = j[accepted]
        found.append(np.column_stack([scores[accepted], np.full(len(j), i), j]))
        num_found += len(j)
        if num_found > MAX_SCORED_PAIRS:
            kept = _strongest(np.concatenate([kept, *found]), count, neighbours, tree=tree)
            found, num_found = [], 0
    kept = _strongest(np.concatenate([kept, *found]), count, neighbours, tree=tree)
    return _unique(kept[:, 1:])


def _strongest(
    scored: NDArray[np.int64], count: int, neighbours: int, *, tree: bool
) -> NDArray[np.int64]:
    """The best pairs of each photograph, and those of the maximum spanning tree. They are among the
    strongest of any part of the pairs that has them.

    Args:
        scored: (M, 3) scores and pairs.
    """
    # Among equal scores, the pairs of earlier photographs come first.
    scored = scored[np.lexsort((scored[:, 2], scored[:, 1], -scored[:, 0]))]
    ends = scored[:, 1:].ravel()
    by_photo = np.argsort(ends, kind="stable")
    photo = ends[by_photo]
    rank = np.empty(len(ends), np.int64)
    rank[by_photo] = np.arange(len(ends)) - np.searchsorted(photo, photo)
    keep: NDArray[np.bool_] = np.any(rank.reshape(-1, 2) < neighbours, axis=1)
    if tree:
        # Weights are the positions from 1: zero means no edge.
        position = np.arange(1, len(scored) + 1, dtype=np.float64)
        edges = csr_matrix((position, (scored[:, 1], scored[:, 2])), shape=(count, count))
        keep[minimum_spanning_tree(edges).data.astype(np.int64) - 1] = True
    return scored[keep]


def _unique(pairs: object) -> list[Pair]:
    ordered = {(min(int(a), int(b)), max(int(a), int(b))) for a, b in pairs}  # type: ignore
    return sorted((a, b) for a, b in ordered if a != b)
