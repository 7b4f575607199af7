"""Initial focal lengths of fisheye lenses without a prior.

A fundamental matrix does not relate the pixels of two fisheye photographs, so their pairs are
verified by the essential matrix, which needs a focal length. Of an equidistant lens at several
focal lengths, the one with the most inliers is taken; mapping refines it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.sfm.keypoints import Keypoints, keypoint_file
from pipeline.sfm.nearest import match_descriptors
from pipeline.sfm.pairs import Pair

# Focal lengths over the longer side: from 280 degrees along it to 72.
FOCALS = tuple(float(v) for v in np.geomspace(0.205, 0.8, 10))
# Numbers of pairs that are matched, and of those with the most matches that decide.
TRIED_PAIRS, USED_PAIRS = 40, 10
MAX_TRIALS = 1000

Match = tuple[NDArray[np.float64], NDArray[np.float64]]


def is_uncalibrated(camera: pycolmap.Camera) -> bool:
    """Whether the camera is a fisheye lens without a prior of its focal length."""
    return "FISHEYE" in camera.model_name and not camera.has_prior_focal_length


def set_initial_focals(
    cameras: Sequence[pycolmap.Camera],
    images: Sequence[tuple[int, str, int]],
    features: Path,
    pairs: Sequence[Pair],
    max_ratio: float,
    seed: int,
) -> list[str]:
    """Set the focal lengths of fisheye lenses without a prior, in place.

    Args:
        images: (image id, name, camera id).
        features: folder of keypoint files.
        pairs: indices into ``images``.

    Returns:
        Sentences for the log.
    """
    decisions = []
    for camera in cameras:
        if not is_uncalibrated(camera):
            continue
        own = [p for p in pairs if all(images[i][2] == camera.camera_id for i in p)]
        matches = _matches(own, images, features, max_ratio)
        if not matches:
            continue
        side = max(camera.width, camera.height)
        inliers = {focal: _inliers(camera, focal * side, matches, seed) for focal in FOCALS}
        best = max(FOCALS, key=lambda focal: inliers[focal])
        set_focal(camera, best * side)
        decisions.append(
            f"camera {camera.camera_id}: initial focal length {best:.2f} times the longer side, "
            f"with the most inliers in {len(matches)} pairs"
        )
    return decisions


def with_prior(camera: pycolmap.Camera) -> pycolmap.Camera:
    """A copy whose pairs are verified by the essential matrix."""
    copy = pycolmap.Camera(camera.todict())
    copy.has_prior_focal_length = True
    return copy


def _matches(
    pairs: Sequence[Pair], images: Sequence[tuple[int, str, int]], features: Path, max_ratio: float
) -> list[Match]:
    """Matched pixels of the pairs with the most matches; neighbours in the order of names come
    first, as they often overlap."""
    ordered = sorted(pairs, key=lambda pair: (pair[1] - pair[0], pair))
    near = ordered[:TRIED_PAIRS]
    names: Mapping[int, str] = {i: images[i][1] for pair in near for i in pair}
    found = {i: Keypoints.read(keypoint_file(features, name)) for i, name in names.items()}
    matches = []
    for a, b in near:
        chosen = match_descriptors(found[a].descriptors, found[b].descriptors, max_ratio)
        xy_a, xy_b = found[a].xy[chosen[:, 0]], found[b].xy[chosen[:, 1]]
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


def set_focal(camera: pycolmap.Camera, focal: float) -> None:
    """Set all focal lengths of a camera, pixels."""
    params = np.array(camera.params)
    params[list(camera.focal_length_idxs())] = focal
    camera.params = params.tolist()
