"""Look-alikes: distinctive pairs, and the continuity of sequences."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pipeline.scene.manifest import Photo
from pipeline.sfm.continuity import broken_steps, sequence_steps
from pipeline.sfm.distinctive import distinctive_pairs
from pipeline.sfm.trusted_pairs import TrustedPairs


def test_pairs_of_a_repeated_part_are_not_distinctive():
    """Eight photographs on a ring: all share 100 keypoints of a repeated part, neighbours share 40
    keypoints more. By their numbers of matches alone, the pairs differ little."""
    repeated = np.arange(100)
    pairs = {}
    for i in range(8):
        for j in range(i + 1, 8):
            a = b = repeated
            if j - i in (1, 7):
                first, second = (i, j) if j - i == 1 else (j, i)
                own = {first: np.arange(100, 140), second: np.arange(140, 180)}
                a, b = np.concatenate([a, own[i]]), np.concatenate([b, own[j]])
            pairs[i, j] = np.column_stack([a, b]).astype(np.uint32)
    ring = {(i, i + 1) for i in range(7)} | {(0, 7)}
    assert distinctive_pairs(pairs) == ring


# Twelve photographs in a row see four sectors each, with 20 points of their own and 20 that repeat
# six sectors further.
ROW, SEEN, POINTS, PERIOD = 12, 4, 20, 6


def row_pairs() -> dict[tuple[int, int], np.ndarray]:
    """The matches of all pairs: of the common sectors, or of those that look alike."""
    pairs = {}
    for i, j in itertools.combinations(range(ROW), 2):
        near = j - i < SEEN
        shift = j - i if near else j - i - PERIOD
        matches = [
            (2 * POINTS * a + k, 2 * POINTS * (a - shift) + k)
            for a in range(SEEN)
            for k in range(0 if near else POINTS, 2 * POINTS)
            if 0 <= a - shift < SEEN
        ]
        pairs[i, j] = np.array(matches, np.uint32).reshape(-1, 2)
    return {pair: matches for pair, matches in pairs.items() if len(matches)}


def trusted(pairs: dict[tuple[int, int], np.ndarray]) -> TrustedPairs:
    xy = np.random.default_rng(0).uniform(size=(ROW, 2 * POINTS * SEEN, 2))
    return TrustedPairs(pairs, dict(enumerate(xy)))


def test_pairs_are_trusted_that_follow_from_trusted_ones():
    """Two neighbours give the pair of the photographs beside the middle one; what follows confirms
    nothing, and no pair of look-alikes follows, although these have as many matches."""
    pairs = row_pairs()
    found = trusted(pairs)
    found.trust([(i, i + 1) for i in range(ROW - 1)])
    assert found.trusted == {(i, j) for i, j in pairs if j - i < 3}


@pytest.mark.parametrize(("across", "groups"), [(6, 1), (1, 2)])
def test_groups_are_connected_only_where_other_pairs_confirm_it(across, groups):
    """Two halves of the row; ``across`` is the number of true pairs between them. Look-alikes
    confirm each other, but are less distinctive."""
    pairs = row_pairs()
    between = [(i, j) for i, j in pairs if i < 6 <= j < i + SEEN]
    for pair in sorted(between, key=lambda pair: pair[1] - pair[0])[across:]:
        del pairs[pair]
    found = trusted(pairs)
    found.trust([(i, i + 1) for i in range(ROW - 1) if i != 5])
    found.connect()
    assert found.num_groups == groups and all(j - i < SEEN for i, j in found.trusted)


def photo(name: str, group: str = "") -> Photo:
    return Photo(name=name, path=name, width=4, height=3, digest="", camera_group=group)


def test_sequences_are_frames_of_one_video():
    frames = [photo(f"{v}/{i:06d}.png", f"{v} 4x3") for v in ("a.mp4", "b.mp4") for i in (0, 7, 9)]
    expected = [
        (f"{v}/{i:06d}.png", f"{v}/{j:06d}.png")
        for v in ("a.mp4", "b.mp4")
        for i, j in ((0, 7), (7, 9))
    ]
    assert sequence_steps([*frames, photo("x.jpg"), photo("y.jpg"), photo("z.jpg")]) == expected
    named = [photo(f"frame_{i:03d}.jpg") for i in range(3)]
    assert sequence_steps(named) == [
        ("frame_000.jpg", "frame_001.jpg"),
        ("frame_001.jpg", "frame_002.jpg"),
    ]


@pytest.mark.parametrize(
    ("yaws", "agrees", "expected"),
    [
        ((0, 10, 20, 30, 40), False, 0),  # Smooth.
        ((0, 10, 20, 200, 210), False, 1),  # Folded: pairs contradict the jump.
        ((0, 10, 20, 200, 210), None, 0),  # A cut.
        ((0, 10, 20, 200, 210), True, 0),  # The camera turned.
        ((0, 10, 200, 30, 40), False, 0),  # One stray photograph.
        ((0, 10, 20, 30, 200), False, 0),  # A stray photograph at the end.
        ((0, 60, 120, 180, 240), False, 0),  # Photographs far apart, evenly.
        ((0, 10, 20, None, 200, 210), False, 1),  # Folded across a frame without a pose.
        ((0, 10, 20, None, 200, 210), None, 0),
    ],
)
def test_a_jump_that_pairs_contradict_breaks_a_sequence(yaws, agrees, expected):
    names = [f"{i}" for i in range(len(yaws))]
    rotations = {}
    for name, degrees in zip(names, yaws, strict=True):
        if degrees is not None:
            c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
            rotations[name] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    steps = list(itertools.pairwise(names))
    found = broken_steps(rotations, lambda pair: agrees, steps)
    assert found == [("2", "3" if "3" in rotations else "4")] * expected
