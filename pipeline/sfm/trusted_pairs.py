"""Pairs of photographs of which the matches can be trusted although parts look alike.

Distinctive pairs are chosen first. Their matches continue from photograph to photograph: a pair of
two photographs that both have a chosen pair with a third is trusted if its own matches lead to the
same keypoints there, and is not if they lead elsewhere (conflicts across triplets: Zach,
Klopschitz, Pollefeys 2010, *Disambiguating Visual Relations Using Loop Constraints*). The groups of
photographs that trusted pairs connect are then connected by the pairs that share most keypoints
which match few other photographs.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.sfm.distinctive import RARITY_POWER
from pipeline.sfm.model_views import Floats, Pairs

Pair = tuple[int, int]
Ints = NDArray[np.int64]

# Largest distance of keypoints that show one point, as a share of the image's longer side.
SAME_PLACE = 0.006
# The smallest number of matches by which a third photograph decides on a pair, and the share of
# them that agree in a trusted pair.
MIN_CHAINED, MIN_AGREEING = 10, 0.8
# The smallest number of other pairs that must follow from a pair that connects two groups.
MIN_FOLLOWING = 2


class TrustedPairs:
    """The pairs trusted so far, and the groups of photographs that they connect."""

    def __init__(self, pairs: Pairs, keypoints: Mapping[int, Floats]) -> None:
        """Trust no pair.

        Args:
            pairs: The verified matches of all pairs.
            keypoints: Image id -> (F, 2) keypoints, as shares of the image's longer side.
        """
        self.trusted: set[Pair] = set()
        self._pairs = pairs
        self._keypoints = keypoints
        self._partners: dict[int, dict[int, Ints]] = {image: {} for image in keypoints}
        self._group = {image: image for image in keypoints}
        for (a, b), matches in pairs.items():
            left, right = matches.astype(np.int64).T
            self._partners[a][b] = _lookup(left, right, len(keypoints[a]))
            self._partners[b][a] = _lookup(right, left, len(keypoints[b]))
        # The photographs with which each has a chosen pair.
        self._neighbours: dict[int, set[int]] = {image: set() for image in keypoints}

    @property
    def num_groups(self) -> int:
        return len(set(self._group.values()))

    def trust(self, chosen: Collection[Pair]) -> None:
        """Trust these pairs, and those that follow from two of them. What follows confirms no
        further pairs: a single wrong pair would spread."""
        fresh = sorted((a, b) for a, b in set(chosen) if b not in self._neighbours[a])
        for a, b in fresh:
            self.trusted.add((a, b))
            self._link(a, b)
            self._merge(a, b)
        for a, b in fresh:
            self.trusted |= self._following(a, b)

    def connect(self) -> None:
        """Connect groups: trust the most distinctive pair of two groups if other pairs confirm it.

        Look-alikes confirm each other too: a group whose most distinctive pair nothing confirms is
        not connected by others.
        """
        grown = True
        while grown:
            grown, unclear = False, set[int]()
            for a, b in self._candidates():
                groups = {self._group[a], self._group[b]}
                if len(groups) == 1 or groups & unclear:
                    continue
                if self._is_supported(a, b):
                    self.trust([(a, b)])
                    grown = True
                else:
                    unclear |= groups

    def _is_supported(self, a: int, b: int) -> bool:
        """Whether enough other pairs between the groups would follow from this one."""
        self._link(a, b)
        following = self._following(a, b)
        self._neighbours[a].remove(b)
        self._neighbours[b].remove(a)
        return len(following) >= MIN_FOLLOWING

    def _following(self, a: int, b: int) -> set[Pair]:
        """The pairs that follow from a chosen pair and another one of one of its photographs."""
        beside = {_sorted(a, c) for c in self._neighbours[b] - {a}}
        beside |= {_sorted(b, c) for c in self._neighbours[a] - {b}}
        new = beside & self._pairs.keys() - self.trusted
        return {pair for pair in new if self._is_confirmed(*pair)}

    def _link(self, a: int, b: int) -> None:
        self._neighbours[a].add(b)
        self._neighbours[b].add(a)

    def _is_confirmed(self, a: int, b: int) -> bool:
        agreeing = total = 0
        left, right = self._pairs[a, b].T
        for c in sorted(self._neighbours[a] & self._neighbours[b]):
            one, other = self._partners[a][c][left], self._partners[b][c][right]
            both = (one >= 0) & (other >= 0)
            xy = self._keypoints[c]
            apart = np.linalg.norm(xy[one[both]] - xy[other[both]], axis=1)
            agreeing += int((apart <= SAME_PLACE).sum())
            total += int(((one >= 0) | (other >= 0)).sum())
        return agreeing >= max(MIN_CHAINED, MIN_AGREEING * total)

    def _candidates(self) -> list[Pair]:
        weight = {image: self._rarity(image) for image in self._keypoints}
        score = {
            (a, b): float(weight[a][matches[:, 0]].sum() + weight[b][matches[:, 1]].sum())
            for (a, b), matches in self._pairs.items()
            if self._group[a] != self._group[b]
        }
        order = sorted(score, key=lambda pair: (-score[pair], pair))
        best: dict[int, Pair] = {}
        for pair in order:
            for image in pair:
                best.setdefault(image, pair)
        return [pair for pair in order if all(best[image] == pair for image in pair)]

    def _rarity(self, image: int) -> Floats:
        """(F,) weights of the keypoints, which fall with the number of photographs of other groups
        that a keypoint matches; a share of the keypoints that match any photograph."""
        outside, known = np.zeros(len(self._keypoints[image])), np.zeros(1, bool)
        for other, partner in self._partners[image].items():
            known = known | (partner >= 0)
            if other not in self._neighbours[image]:
                outside += partner >= 0
        rare = np.where(outside > 0, 1 / np.maximum(outside, 1) ** RARITY_POWER, 0)
        return np.asarray(rare / max(int(known.sum()), 1))

    def _merge(self, a: int, b: int) -> None:
        old, new = self._group[a], self._group[b]
        if old != new:
            self._group = {i: new if g == old else g for i, g in self._group.items()}


def _sorted(a: int, b: int) -> Pair:
    return (a, b) if a < b else (b, a)


def _lookup(left: Ints, right: Ints, size: int) -> Ints:
    """(size,) the partner of each keypoint; -1 for none."""
    table = np.full(size, -1, np.int64)
    table[left] = right
    return table
