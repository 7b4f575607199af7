"""Initial focal lengths of fisheye lenses without a prior.

A fundamental matrix does not relate the pixels of two fisheye photographs, so their pairs are
verified by the essential matrix, which needs a focal length. Of an equidistant lens at several
focal lengths, the one with the most inliers is taken; mapping refines it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.sfm.database import MatchingInputs
from pipeline.sfm.models import is_uncalibrated, set_focal, with_prior
from pipeline.sfm.nearest import match_descriptors
from pipeline.sfm.pairs import Pair

# Focal lengths over the longer side: from 280 degrees along it to 72.
FOCALS = tuple(float(v) for v in np.geomspace(0.205, 0.8, 10))
# Numbers of pairs that are matched, and of those with the most matches that decide.
TRIED_PAIRS, USED_PAIRS = 40, 10
MAX_TRIALS = 1000

Match = tuple[NDArray[np.float64], NDArray[np.float64]]


def set_initial_focals(inputs: MatchingInputs, pairs: Sequence[Pair]) -> list[str]:
    """Set the focal lengths of fisheye lenses without a prior, in place.

    Args:
        pairs: Indices into the images.

    Returns:
        Sentences for the log.
    """
    decisions = []
    for camera in filter(is_uncalibrated, inputs.cameras):
        own = [p for p in pairs if all(inputs.images[i][2] == camera.camera_id for i in p)]
        matches = _matches(inputs, own)
        if not matches:
            continue
        side = max(camera.width, camera.height)
        inliers = {focal: _inliers(camera, focal * side, matches, inputs.seed) for focal in FOCALS}
        best = max(FOCALS, key=lambda focal: inliers[focal])
        set_focal(camera, best * side)
        decisions.append(
            f"camera {camera.camera_id}: initial focal length {best:.2f} times the longer side, "
            f"with the most inliers in {len(matches)} pairs"
        )
    return decisions


def _matches(inputs: MatchingInputs, pairs: Sequence[Pair]) -> list[Match]:
    """Matched pixels of the pairs with the most matches; neighbours in the order of names come
    first, as they often overlap."""
    matches = []
    for pair in sorted(pairs, key=lambda pair: (pair[1] - pair[0], pair))[:TRIED_PAIRS]:
        a, b = (inputs.keypoints(inputs.images[i][0]) for i in pair)
        chosen = match_descriptors(a.descriptors, b.descriptors, inputs.max_ratio)
        xy_a, xy_b = a.xy[chosen[:, 0]], b.xy[chosen[:, 1]]
        matches.append((xy_a.astype(np.float64), xy_b.astype(np.float64)))
    matches.sort(key=lambda match: -len(match[0]))
    return [match for match in matches[:USED_PAIRS] if len(match[0]) >= 8]


def _inliers(camera: pycolmap.Camera, focal: float, matches: list[Match], seed: int) -> int:
    """Number of inliers of all pairs."""
    trial = with_prior(camera)
    set_focal(trial, focal)
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    options.ransac.max_num_trials = MAX_TRIALS
    total = 0
    for xy_a, xy_b in matches:
        order = np.repeat(np.arange(len(xy_a), dtype=np.uint32)[:, None], 2, axis=1)
        geometry = pycolmap.estimate_calibrated_two_view_geometry(
            trial, xy_a, trial, xy_b, order, options
        )
        total += len(geometry.inlier_matches)
    return total
