"""The similarity between two models of one scene, from what their photographs have in common.

A keypoint that both models triangulated, or a verified match of a photograph of one model with a
photograph of the other, gives a point in both worlds. Each pair of photographs is a link. A wrong
pair agrees with some similarity as well as a right one does: a joint needs several links of
different photographs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.similarity import Similarity, umeyama
from pipeline.sfm.model_views import Floats, ModelView, Pairs

# Largest error of an agreeing correspondence, as a share of the image's longer side.
MAX_ERROR = 0.006
# Smallest number of correspondences of a link, and the largest that is used.
MIN_CORRESPONDENCES, MAX_CORRESPONDENCES = 6, 60
# A link agrees if at least this share of its correspondences do.
MIN_AGREEING_SHARE = 0.5
# Smallest number of links that agree, and their smallest share of all links.
MIN_LINKS, MIN_LINKS_SHARE = 3, 0.75
# Smallest number of photographs of each model that have a link that agrees.
MIN_PHOTOGRAPHS = 2
HYPOTHESES, SAMPLE = 1000, 4
REFINEMENTS = 10

Views = dict[int, ModelView]


@dataclass(frozen=True)
class Joint:
    """A similarity between two models that several pairs of photographs support.

    Attributes:
        similarity: The transform from the world of the second model to that of the first.
        links: The ids of the pairs that agree, of the first and the second model; a photograph that
            both have is a pair with itself.
    """

    similarity: Similarity
    links: list[tuple[int, int]]


class _Correspondences(NamedTuple):
    """Points in two worlds, (N, 3) each, with the cameras that see them.

    ``bound_*`` is the largest angle in radians between the rays of an agreeing correspondence.
    """

    first: Floats
    second: Floats
    centre_first: Floats
    centre_second: Floats
    bound_first: Floats
    bound_second: Floats
    link: NDArray[np.intp]

    def chosen(self, rows: NDArray[np.bool_]) -> _Correspondences:
        return _Correspondences(
            self.first[rows],
            self.second[rows],
            self.centre_first[rows],
            self.centre_second[rows],
            self.bound_first[rows],
            self.bound_second[rows],
            self.link[rows],
        )

    def agree(self, similarity: Similarity) -> NDArray[np.bool_]:
        """(N,) True where each point is seen where the other one is, by both cameras."""
        s = similarity
        inverse = Similarity(1 / s.scale, s.rotation.T, -s.rotation.T @ s.translation / s.scale)
        return np.asarray(
            (_angles(self.first, s(self.second), self.centre_first) <= self.bound_first)
            & (_angles(self.second, inverse(self.first), self.centre_second) <= self.bound_second)
        )


def find_joint(
    first: Views, second: Views, points: tuple[dict[int, Floats], dict[int, Floats]], pairs: Pairs
) -> Joint | None:
    """The similarity between two models; None if too few pairs of photographs support one.

    Args:
        first, second: The registered images of the models, by id.
        points: For each model, the positions of its points by their ids.
        pairs: The verified matches of all photographs.
    """
    links = _links(first, second, pairs)
    found = _correspondences(first, second, points, links)
    count = np.bincount(found.link, minlength=len(links))
    counted = np.flatnonzero(count >= MIN_CORRESPONDENCES)
    if len(counted) < MIN_LINKS:
        return None
    found = found.chosen(np.isin(found.link, counted))
    similarity = _fit(found, len(links))
    if similarity is None:
        return None
    agreeing = np.bincount(found.link[found.agree(similarity)], minlength=len(links))
    good = counted[agreeing[counted] >= MIN_AGREEING_SHARE * count[counted]]
    chosen = [link[:2] for index, link in enumerate(links) if index in set(good)]
    enough = len(chosen) >= max(MIN_LINKS, MIN_LINKS_SHARE * len(counted))
    photographs = [len(set(side)) for side in zip(*chosen, strict=True)]
    if not enough or min(photographs) < MIN_PHOTOGRAPHS:
        return None
    return Joint(similarity, chosen)


_Link = tuple[int, int, NDArray[np.intp], NDArray[np.intp]]


def _links(first: Views, second: Views, pairs: Pairs) -> list[_Link]:
    """Image ids of both models and the keypoints of each, for shared photographs and for pairs of
    photographs that only one of the models has."""
    shared = sorted(first.keys() & second.keys())
    links = []
    for image_id in shared:
        every = np.arange(len(first[image_id].observed))
        links.append((image_id, image_id, every, every))
    only_first, only_second = first.keys() - second.keys(), second.keys() - first.keys()
    for (a, b), matches in pairs.items():
        left, right = matches.T.astype(np.intp)
        if a in only_first and b in only_second:
            links.append((a, b, left, right))
        elif b in only_first and a in only_second:
            links.append((b, a, right, left))
    return links


def _correspondences(
    first: Views,
    second: Views,
    points: tuple[dict[int, Floats], dict[int, Floats]],
    links: list[_Link],
) -> _Correspondences:
    places: list[Floats] = []
    bounds, number = list[tuple[float, float]](), list[int]()
    for index, (a, b, left, right) in enumerate(links):
        one, other = first[a], second[b]
        ids_a, ids_b = one.observed[left], other.observed[right]
        known = np.flatnonzero((ids_a >= 0) & (ids_b >= 0))
        if len(known) > MAX_CORRESPONDENCES:
            step = np.linspace(0, len(known) - 1, MAX_CORRESPONDENCES).round().astype(np.intp)
            known = known[step]
        for i, j in zip(ids_a[known].tolist(), ids_b[known].tolist(), strict=True):
            places.append(np.stack([points[0][i], points[1][j], one.centre, other.centre]))
        bounds += [(_bound(one), _bound(other))] * len(known)
        number += [index] * len(known)
    xyz = np.array(places, np.float64).reshape(-1, 4, 3).transpose(1, 0, 2)
    angles = np.array(bounds, np.float64).reshape(-1, 2).T
    one_xyz, other_xyz, centre_a, centre_b = xyz
    number_of_link = np.array(number, np.intp)
    return _Correspondences(
        one_xyz, other_xyz, centre_a, centre_b, angles[0], angles[1], number_of_link
    )


def _bound(view: ModelView) -> float:
    return MAX_ERROR * view.side / view.focal


def _fit(found: _Correspondences, num_links: int) -> Similarity | None:
    """The similarity that most correspondences agree with, each link counting alike (RANSAC), then
    least squares on those that agree."""
    rng = np.random.default_rng(0)
    weight = 1 / np.maximum(np.bincount(found.link, minlength=num_links), 1)[found.link]
    best, most = None, 0.0
    for _ in range(HYPOTHESES):
        chosen = rng.choice(len(found.link), SAMPLE, replace=False, p=weight / weight.sum())
        proposal = Similarity(*umeyama(found.second[chosen], found.first[chosen]))
        if not proposal.scale > 0 or not np.isfinite(proposal.scale):
            continue
        score = float(weight[found.agree(proposal)].sum())
        if score > most:
            best, most = proposal, score
    for _ in range(REFINEMENTS if best is not None else 0):
        assert best is not None
        inliers = found.agree(best)
        refined = Similarity(*umeyama(found.second[inliers], found.first[inliers]))
        score = float(weight[found.agree(refined)].sum()) if refined.scale > 0 else 0.0
        if score < most or inliers.sum() < SAMPLE:
            break
        if np.array_equal(found.agree(refined), inliers):
            return refined
        best, most = refined, score
    return best


def _angles(a: Floats, b: Floats, centre: Floats) -> Floats:
    """(N,) angles in radians between the rays from cameras to two points."""
    u, v = a - centre, b - centre
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(1)))
