"""Grades a model by the errors of its poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.similarity import umeyama
from pipeline.io.names import NameIndex
from pipeline.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Grade = Literal["good", "weak", "failed"]

# The error bounds of a correct view, after the similarity with the most correct views.
ROTATION_DEG, CENTRE_SHARE = 5.0, 0.05
# The shares of correct views among those with a pose and a true one: a model is good from the
# first, and has failed below the second.
GOOD_SHARE, FAILED_SHARE = 0.9, 0.6
# A model with a smaller share of the photographs has failed, and is not good, however right its
# views are.
FAILED_REGISTERED, GOOD_REGISTERED = 0.5, 0.8
# Cameras that moved less, as a share of their distance to the scene, observe no depth.
MIN_TRUE_MOTION = 0.01
HYPOTHESES = 600


@dataclass(frozen=True)
class Truth:
    """The grade of a model and its errors.

    Attributes:
        grade: The grade by ``share``. It is "failed" too if there is no model or one of too few
            photographs, or if the true cameras never moved; a model that lacks some of the
            photographs is at most "weak".
        share: The share of correct views among those that have a pose and a true one.
        common: The number of views that have a pose and a true one.
        rotation_deg, centre: The median errors over those of these views that show the model's
            scene, after the robust similarity; the centre relative to the true radius. None if no
            similarity was found.
    """

    grade: Grade
    share: float
    common: int
    rotation_deg: float | None
    centre: float | None


def grade(
    estimated: Reconstruction | None,
    truths: Sequence[Reconstruction],
    total: int,
    depth: float | None = None,
) -> Truth:
    """Grade a model.

    Args:
        truths: The true cameras of each photographed scene. The model is taken to be of the scene
            that most of its views show; its views of the others are wrong.
        total: The number of photographs.
        depth: The typical distance of what the cameras saw, in the truth's unit; None if unknown.
    """
    if estimated is None:
        return Truth("failed", 0.0, 0, None, None)
    posed = estimated.by_name()
    index = NameIndex(posed)
    found = [
        [
            (posed[match], true)
            for name, true in sorted(truth.by_name().items())
            if (match := index.find(name)) is not None
        ]
        for truth in truths
    ]
    pairs = max(found, key=len)
    common = sum(len(each) for each in found)
    if len(pairs) < 2:
        return Truth("failed", 0.0, common, None, None)
    r_found, r_true = (np.stack([p[k].rotation for p in pairs]) for k in (0, 1))
    c_found, c_true = (np.stack([p[k].centre for p in pairs]) for k in (0, 1))
    radius = float(np.sqrt(((c_true - c_true.mean(0)) ** 2).sum(1).mean()))
    rotation, centre = _residuals(r_found, c_found, r_true, c_true)
    relative = centre / max(radius, 1e-12)
    right = (rotation <= ROTATION_DEG) & (relative <= CENTRE_SHARE)
    share = float(right.sum()) / common
    still = depth is not None and radius < MIN_TRUE_MOTION * depth
    registered = len(estimated.images) / total
    is_good = share >= GOOD_SHARE and registered >= GOOD_REGISTERED
    verdict: Grade = "good" if is_good else "weak"
    if share < FAILED_SHARE or still or registered < FAILED_REGISTERED:
        verdict = "failed"
    return Truth(verdict, share, common, _median(rotation), _median(relative))


def _median(values: Array) -> float | None:
    """The median; None for the infinite residuals without a similarity."""
    middle = float(np.median(values))
    return middle if np.isfinite(middle) else None


def _residuals(r_found: Array, c_found: Array, r_true: Array, c_true: Array) -> tuple[Array, Array]:
    """The degrees and distances that the best similarity leaves: the one that makes most views
    right, of those that one view's rotation and two views' distance propose, and of the
    least-squares ones on what these explain."""
    rng = np.random.default_rng(0)
    count = len(c_true)
    radius = float(np.sqrt(((c_true - c_true.mean(0)) ** 2).sum(1).mean()))
    best: tuple[tuple[int, float], Array, Array] | None = None

    def consider(scale: float, world: Array, shift: Array) -> NDArray[np.bool_]:
        nonlocal best
        rotation = _angles(r_found @ world.T, r_true)
        centre = np.linalg.norm(scale * c_found @ world.T + shift - c_true, axis=1)
        right = (rotation <= ROTATION_DEG) & (centre <= CENTRE_SHARE * radius)
        miss = np.minimum(rotation / ROTATION_DEG, 1) + np.minimum(
            centre / max(CENTRE_SHARE * radius, 1e-12), 1
        )
        score = (int(right.sum()), -float(miss.sum()))
        if best is None or score > best[0]:
            best = (score, rotation, centre)
        return np.asarray(right)

    for _ in range(HYPOTHESES if count > 2 else 4):
        i, j = rng.choice(count, 2, replace=False)
        span = float(np.linalg.norm(c_found[i] - c_found[j]))
        if span < 1e-12:
            continue
        scale = float(np.linalg.norm(c_true[i] - c_true[j])) / span
        world = r_true[i].T @ r_found[i]
        shift = c_true[i] - scale * world @ c_found[i]
        right = consider(scale, world, shift)
        if right.sum() >= 3:
            # Collinear centres leave a rotation about their line, which the cameras determine.
            u, _, vt = np.linalg.svd(np.einsum("nij,nik->jk", r_true[right], r_found[right]))
            world = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
            scale, _, _ = umeyama(c_found[right] @ world.T, c_true[right])
            shift = c_true[right].mean(0) - scale * world @ c_found[right].mean(0)
            consider(scale, world, shift)
            consider(*umeyama(c_found[right], c_true[right]))
    if best is None:
        return np.full(count, np.inf), np.full(count, np.inf)
    return best[1], best[2]


def _angles(first: Array, second: Array) -> Array:
    cosine = (np.einsum("nij,nij->n", first, second) - 1) / 2
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
