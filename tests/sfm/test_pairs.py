"""Selection of image pairs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.sfm import pairs as choose


def proper(pairs, count):
    assert pairs == sorted(set(pairs))
    assert all(0 <= i < j < count for i, j in pairs)


def descriptors(rng, ids, noise=2.0):
    """Descriptors of the scene points ``ids``; those of the same point differ by noise only."""
    table = np.random.default_rng(99).uniform(0, 90, (2000, 128))
    return np.clip(table[ids] + rng.normal(0, noise, (len(ids), 128)), 0, 255).astype(np.uint8)


def scores(photographs):
    """The symmetric matrix of all scores."""
    table = np.zeros((len(photographs), len(photographs)), np.int64)
    for i, first, row in choose.retrieval_scores(photographs):
        table[i, first : first + len(row)] = row
    return table + table.T


@settings(max_examples=40, derandomize=True, deadline=None)
@given(count=st.integers(0, 40), overlap=st.integers(1, 12))
def test_sequential_pairs_contain_each_overlapping_pair_once(count, overlap):
    found = choose.sequential_pairs(count, overlap)
    proper(found, count)
    assert {(i, j) for i, j in choose.exhaustive_pairs(count) if j - i <= overlap} <= set(found)
    far = {j - i for i, j in found if j - i > overlap}
    assert all(step & (step - 1) == 0 for step in far)


def test_exhaustive_pairs():
    assert choose.exhaustive_pairs(3) == [(0, 1), (0, 2), (1, 2)]


def test_spatial_pairs_use_horizontal_distance_and_skip_photographs_without_gps():
    # 55.7 degrees north: a degree of longitude is 0.56 of one of latitude. From 0, photograph 2
    # (0.0015 degrees east, 94 m) is nearer than 3 (0.001 north, 111 m). Altitudes are ignored.
    gps = [(55.7, 13.1, 0.0), None, (55.7, 13.1015, 900.0), (55.701, 13.1, 0.0)]
    found = choose.spatial_pairs(gps, 1)
    proper(found, 4)
    assert (0, 2) in found
    assert all(1 not in pair for pair in found)
    assert choose.spatial_pairs([None, (1.0, 1.0, 0.0)], 3) == []


def test_proximity_pairs_prefer_similar_viewing_directions():
    centres = np.array([[0.0, 0, 0], [0.1, 0, 0], [1.0, 0, 0], [1.2, 0, 0]])
    directions = np.array([[0.0, 0, 1], [0, 0, -1], [0, 0, 1], [0, 0, 1]])
    found = choose.proximity_pairs(centres, directions, 2)
    proper(found, 4)
    # Camera 1 is nearest to 0, but faces the opposite direction.
    assert found == [(0, 2), (0, 3), (2, 3)]


def test_retrieval_pairs_share_points():
    rng = np.random.default_rng(0)
    photographs = [
        descriptors(rng, rng.permutation(np.arange(start, start + 200)))
        for start in (0, 100, 1000, 1100)
    ]
    score = scores(photographs)
    # Neighbours share 100 of 200 points; nothing else is shared.
    assert 90 <= score[0, 1] <= 100 and 90 <= score[2, 3] <= 100
    assert score[0, 2] < choose.RETRIEVAL_MIN_SCORE
    assert choose.retrieval_pairs(photographs, 2) == [(0, 1), (2, 3)]


def test_retrieval_scores_equal_plain_mutual_nearest_neighbours():
    rng = np.random.default_rng(1)
    counts = (40, 1, 0, 300, 75)
    photographs = [descriptors(rng, rng.integers(0, 60, n), noise=9.0) for n in counts]
    score = scores(photographs)
    for i, first in enumerate(photographs):
        for j, second in enumerate(photographs[:i]):
            expected = 0
            if len(first) and len(second) > 1:
                # The ratio test is applied to the descriptors of the first photograph.
                a, b = second.astype(float), first.astype(float)
                squared = ((a[:, None] - b[None]) ** 2).sum(-1)
                for row, near in enumerate(squared.argmin(1)):
                    second_best = np.partition(squared[row], 1)[1] if len(b) > 1 else np.inf
                    ok = squared[row, near] < choose.RETRIEVAL_RATIO**2 * second_best
                    expected += int(ok and squared[:, near].argmin() == row)
                assert score[i, j] == expected, (i, j)


def test_the_spanning_tree_keeps_the_view_graph_connected():
    # The best neighbour alone gives (0, 1) and (2, 3), which are not connected.
    rng = np.random.default_rng(2)
    ids = [np.r_[0:100], np.r_[20:100, 500:520], np.r_[500:520, 600:680], np.r_[600:680, 700:720]]
    photographs = [descriptors(rng, i) for i in ids]
    assert choose.retrieval_pairs(photographs, 1) == [(0, 1), (1, 2), (2, 3)]


def plain_pairs(score, neighbours, *, overlap=0, tree):
    """The pairs by sorting all scores, and Kruskal's algorithm."""
    count = len(score)
    valid = [(i, j) for i, j in choose.exhaustive_pairs(count) if score[i, j] >= 4]
    valid = [(i, j) for i, j in valid if j - i > overlap]
    ordered = sorted(valid, key=lambda pair: (-score[pair], pair))
    found = set()
    for photo in range(count):
        found |= set([pair for pair in ordered if photo in pair][:neighbours])
    group = list(range(count))
    for i, j in ordered if tree else ():
        if group[i] != group[j]:
            found.add((i, j))
            group = [group[i] if g == group[j] else g for g in group]
    return sorted(found)


@pytest.mark.parametrize("limit", [1, 50, 10**6])
@pytest.mark.parametrize("batch", [3, 64])
def test_pairs_do_not_depend_on_how_many_scores_are_in_memory(monkeypatch, limit, batch):
    monkeypatch.setattr(choose, "MAX_SCORED_PAIRS", limit)
    monkeypatch.setattr(choose, "RETRIEVAL_BATCH", batch)
    rng = np.random.default_rng(4)
    # Two places without a photograph of both, but for one; equal scores are frequent.
    starts = [*rng.integers(0, 60, 20), *rng.integers(500, 560, 20), 0]
    ids = [np.r_[start : start + 40] for start in starts]
    ids[-1] = np.r_[20:30, 520:530]
    photographs = [descriptors(rng, i, noise=0.0) for i in ids]
    score = scores(photographs)
    assert choose.retrieval_pairs(photographs, 3) == plain_pairs(score, 3, tree=True)
    closures = plain_pairs(score, choose.LOOP_CLOSURES, overlap=5, tree=False)
    assert choose.loop_closure_pairs(photographs, 5) == closures


def test_loop_closures_are_beyond_the_overlap():
    rng = np.random.default_rng(3)
    ids = [np.r_[0:80], np.r_[40:120], np.r_[300:380], np.r_[0:80]]
    photographs = [descriptors(rng, i) for i in ids]
    found = choose.loop_closure_pairs(photographs, 1)
    proper(found, 4)
    assert (0, 3) in found and (0, 1) not in found


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_photographs_have_no_pairs(count):
    few = [np.zeros((5, 128), np.uint8)] * count
    assert choose.retrieval_pairs(few, 5) == []
    assert choose.proximity_pairs(np.zeros((count, 3)), np.zeros((count, 3)), 5) == []
    assert choose.sequential_pairs(count, 5) == []
