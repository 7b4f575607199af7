"""Two-view geometry of rays, for every camera model: the angles by which matches miss a relative
pose, and the matches that agree on a relative pose that is not known.

Rays are unit vectors in the cameras' frames. A relative pose takes points of the first camera to
the second: x2 = R x1 + t.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Largest number of samples of eight matches that ``consistent_matches`` tries: with half of the
# matches wrong, one of them holds right ones alone with this probability. Samples are compared in
# batches, and fewer are tried where more of the matches are right.
_SAMPLES, _CERTAINTY = 1200, 0.99
_BATCH = 150
_SAMPLE_SIZE = 8
# Matches, evenly distributed in their order, by which the samples are compared.
_JUDGED = 400
_REFITS = 3
# Below this, translations are zero and directions parallel.
_TINY = 1e-9


def epipolar_angles(one: Array, two: Array, rotation: Array, translation: Array) -> Array:
    """(...,) the angles in radians by which matches miss a relative pose; pi for rays that are
    not finite.

    A point in front of the first camera is seen by the second one on an arc: from the direction of
    the first camera's centre, for a point there, to the direction of the first ray, for a point at
    infinity. The angle is the distance of the second ray from this arc, or that of the first ray
    from its arc if it is larger. Points behind a camera are therefore misses.

    Args:
        one, two: (..., 3) rays.
        rotation: (..., 3, 3), a reflection if the world is mirrored.
        translation: (..., 3), of any length; 0 for cameras in one place.
    """
    transposed = np.swapaxes(rotation, -1, -2)
    length = np.linalg.norm(translation, axis=-1, keepdims=True)
    towards = translation / np.where(length > _TINY, length, 1.0)
    back = -_apply(transposed, towards)
    seen = np.maximum(
        _arc_distance(_apply(rotation, one), towards, two),
        _arc_distance(_apply(transposed, two), back, one),
    )
    return np.where(np.isfinite(seen), seen, np.pi)


def _arc_distance(start: Array, end: Array, rays: Array) -> Array:
    """The angles from ``rays`` to the shorter arcs of great circles from ``start`` to ``end``; to
    ``start`` where ``end`` is zero."""
    ends = _angle(start, rays)
    has_end = np.einsum("...i,...i->...", end, end) > 0.5
    ends = np.where(has_end, np.minimum(ends, _angle(end, rays)), ends)
    normal = np.cross(start, end)
    length = np.linalg.norm(normal, axis=-1)
    normal = normal / np.maximum(length, _TINY)[..., None]
    inside = np.einsum("...i,...i->...", np.cross(normal, start), rays) >= 0
    inside &= np.einsum("...i,...i->...", np.cross(end, normal), rays) >= 0
    plane = np.abs(np.arcsin(np.clip(np.einsum("...i,...i->...", normal, rays), -1.0, 1.0)))
    return np.where(inside & (length > 1e-6), plane, ends)


def _apply(matrix: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("...ij,...j->...i", matrix, vectors))


def _angle(a: Array, b: Array) -> Array:
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.arctan2(sine, np.einsum("...i,...i->...", a, b)))


def consistent_matches(one: Array, two: Array, tolerance: float) -> NDArray[np.bool_]:
    """(N,) the matches that agree on one essential or fundamental matrix: the largest such set of
    a fixed number of random samples (RANSAC with the eight-point algorithm, always the same
    samples).

    Directions need not be those of the right intrinsics: a linear change of the directions of
    either camera changes the matrix, not the matches that agree.

    Args:
        one, two: (N, 3) unit directions.
        tolerance: The largest angle between a direction and its epipolar plane, radians.
    """
    count = len(one)
    if count < 2 * _SAMPLE_SIZE:
        return np.zeros(count, np.bool_)
    products = np.einsum("ni,nj->nij", two, one).reshape(count, 9)
    rng = np.random.default_rng(0)
    judged = np.linspace(0, count - 1, min(count, _JUDGED)).astype(np.int64)
    most, matrix = -1, np.zeros((1, 3, 3))
    for tried in range(_BATCH, _SAMPLES + 1, _BATCH):
        order = np.argpartition(rng.random((_BATCH, count)), _SAMPLE_SIZE, axis=1)
        rows = products[order[:, :_SAMPLE_SIZE]]
        # The eigenvector of the smallest eigenvalue is the matrix whose products are zero.
        matrices = np.linalg.eigh(np.swapaxes(rows, 1, 2) @ rows)[1][:, :, 0].reshape(-1, 3, 3)
        agree = (_plane_angles(matrices, one[judged], two[judged]) < tolerance).sum(axis=1)
        first = int(agree.argmax())
        if agree[first] > most:
            most, matrix = int(agree[first]), matrices[first : first + 1]
        if (1 - (most / len(judged)) ** _SAMPLE_SIZE) ** tried < 1 - _CERTAINTY:
            break
    best = _plane_angles(matrix, one, two)[0] < tolerance
    for _ in range(_REFITS):
        if best.sum() < _SAMPLE_SIZE:
            break
        rows = products[best]
        matrix = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(1, 3, 3)
        refined = _plane_angles(matrix, one, two)[0] < tolerance
        if refined.sum() <= best.sum():
            break
        best = refined
    return np.asarray(best)


def _plane_angles(matrices: Array, one: Array, two: Array) -> Array:
    """(S, N) the larger of the angles of both directions to their epipolar planes."""
    normals_two = np.einsum("sij,nj->sni", matrices, one)
    normals_one = np.einsum("sij,ni->snj", matrices, two)
    product = np.abs(np.einsum("sni,ni->sn", normals_two, two))
    length = np.minimum(np.linalg.norm(normals_two, axis=-1), np.linalg.norm(normals_one, axis=-1))
    return np.asarray(product / np.maximum(length, _TINY))
