"""Poses of photographs by their matches with all photographs of a model at once.

A pair with too few matches to be verified by itself still has matches with points of the model, and
those of all pairs together determine a pose. Wrong matches agree with a pose by chance only: a pose
is accepted if so many would hardly ever do.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict
from dataclasses import dataclass
from math import comb, log10, pi
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.sfm.mappers import with_fisheye_priors
from pipeline.sfm.model_views import Floats, read_views

#: Largest distance of a keypoint from its projected point, as a share of the longer side.
MAX_ERROR = 0.006
#: Smallest number of keypoints that agree with the pose, and of photographs that they match.
MIN_KEYPOINTS, MIN_PHOTOGRAPHS = 12, 3
#: Largest expected number of poses that as many wrong matches agree with, as a power of ten.
MAX_LOG_FALSE_ALARMS = -6.0
MAX_TRIALS = 20_000

Matches = dict[int, NDArray[np.uint32]]
"""Registered image -> (M, 2) keypoints of the photograph and of that image."""


@dataclass(frozen=True)
class Resected:
    """A pose of a photograph.

    Attributes:
        pose: The transform from world to camera.
        observations: The photograph's keypoints and the ids of the points that they observe.
    """

    pose: pycolmap.Rigid3d
    observations: list[tuple[int, int]]


def resect(
    model: pycolmap.Reconstruction, database: Path, images: set[int]
) -> tuple[pycolmap.Reconstruction, set[int]]:
    """Register photographs in a model; its poses, points and cameras stay as they are. Runs on one
    thread.

    Args:
        database: The database that the model was mapped from; not changed. Matches count whether
            they are verified or not.
        images: The ids of the photographs that are tried.

    Returns:
        The model with more photographs, and their ids; without any, the same model.
    """
    with pycolmap.Database.open(database) as opened:
        views = read_views(model, opened)
        cameras = {image.image_id: image.camera_id for image in opened.read_all_images()}
        found = {}
        for image_id in sorted(images):
            if cameras[image_id] not in model.cameras:
                continue
            matches = {
                other: opened.read_matches(image_id, other)
                for other in views
                if opened.exists_matches(image_id, other)
            }
            points = {other: views[other].observed[m[:, 1]] for other, m in matches.items()}
            xy = opened.read_keypoints(image_id)[:, :2].astype(np.float64)
            pose = _pose(model, model.camera(cameras[image_id]), xy, matches, points)
            if pose is not None:
                found[image_id] = pose
    return (_with_registered(model, database, found), set(found)) if found else (model, set())


def _pose(
    model: pycolmap.Reconstruction,
    camera: pycolmap.Camera,
    xy: Floats,
    matches: Matches,
    points: dict[int, NDArray[np.int64]],
) -> Resected | None:
    """The pose that enough matches agree with; ``points``: the point of each match, -1 for none."""
    seen_with: defaultdict[tuple[int, int], set[int]] = defaultdict(set)
    for other, pairs in matches.items():
        for keypoint, point in zip(pairs[:, 0].tolist(), points[other].tolist(), strict=True):
            if point >= 0:
                seen_with[keypoint, point].add(other)
    candidates = sorted(seen_with)
    if len({keypoint for keypoint, _ in candidates}) < MIN_KEYPOINTS:
        return None
    bound = MAX_ERROR * max(camera.width, camera.height)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = bound
    options.ransac.random_seed = 0
    options.ransac.min_inlier_ratio = MIN_KEYPOINTS / max(len(candidates), 2 * MIN_KEYPOINTS)
    options.ransac.max_num_trials = MAX_TRIALS
    estimate = pycolmap.estimate_and_refine_absolute_pose(
        xy[[keypoint for keypoint, _ in candidates]],
        np.array([model.point3D(point).xyz for _, point in candidates]),
        camera,
        options,
    )
    if estimate is None:
        return None
    chosen = [candidates[index] for index in np.flatnonzero(estimate["inlier_mask"])]
    observations = list(dict(reversed(chosen)).items())
    photographs = {other for candidate in chosen for other in seen_with[candidate]}
    chance = pi * bound**2 / (camera.width * camera.height)
    if (
        len(observations) < MIN_KEYPOINTS
        or len(photographs) < MIN_PHOTOGRAPHS
        or _log_false_alarms(len(candidates), len(observations), chance) > MAX_LOG_FALSE_ALARMS
    ):
        return None
    return Resected(estimate["cam_from_world"], sorted(observations))


def _log_false_alarms(count: int, agreeing: int, chance: float) -> float:
    """Logarithm of the expected number of poses through three of ``count`` wrong matches, four
    solutions each, that so many agree with, each with this chance (Moisan and Stival 2004)."""
    poses, subsets = 4 * comb(count, 3), comb(count - 3, agreeing - 3)
    return log10(poses) + log10(subsets) + (agreeing - 3) * log10(chance)


def _with_registered(
    model: pycolmap.Reconstruction, database: Path, found: dict[int, Resected]
) -> pycolmap.Reconstruction:
    more = pycolmap.Reconstruction(model)
    with (
        tempfile.TemporaryDirectory(dir=database.parent) as folder,
        pycolmap.Database.open(with_fisheye_priors(database, Path(folder))) as opened,
    ):
        cache = pycolmap.DatabaseCache.create(
            opened, pycolmap.DatabaseCacheOptions(load_all_images=True)
        )
    more.load(cache)
    for image_id, resected in found.items():
        image = more.image(image_id)
        more.frame(image.frame_id).set_cam_from_world(image.camera_id, resected.pose)
        more.register_frame(image.frame_id)
        for keypoint, point in resected.observations:
            more.add_observation(point, pycolmap.TrackElement(image_id, keypoint))
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0)
    options.triangulation.ignore_two_view_tracks = False
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(more)
    for image_id in sorted(found):
        mapper.triangulate_image(options.get_triangulation(), image_id)
    mapper.end_reconstruction(False)
    more.tear_down()
    more.update_point_3d_errors()
    return more
