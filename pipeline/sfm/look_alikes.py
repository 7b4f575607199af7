"""Leaves out pairs that match although they show different parts that look alike."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.sfm.consistency import MIN_AGREEING_SHARE, matches_agree
from pipeline.sfm.distinctive import distinctive_pairs
from pipeline.sfm.evidence import read_verified_pairs
from pipeline.sfm.mappers import run_mapper
from pipeline.sfm.model_views import Floats, ModelView, Pairs, read_views
from pipeline.sfm.models import uncalibrated
from pipeline.sfm.trusted_pairs import SAME_PLACE, TrustedPairs

# Number of times that the trusted pairs are mapped. A chain of few pairs bends with a focal length
# that is far from the true one; the result is a better start.
PASSES = 3
# The smallest number of matches of an added pair whose points the model has, and the smallest share
# of them that agree.
MIN_KNOWN, MIN_AGREEING = 10, 0.75


def leave_out_look_alikes(
    source: Path, neighbours: Collection[tuple[str, str]], total: int, seed: int, target: Path
) -> bool:
    """Copy a database without the pairs that contradict the models of its trusted pairs.

    The trusted pairs are mapped alone. They are kept, and those of the other pairs that agree with
    one of their models. Pairs that no model holds are left out. Cameras without a prior start at
    the focal lengths found.

    Args:
        neighbours: The names of neighbours in a sequence, whose pairs are trusted too.
        total: The number of photographs.

    Returns:
        Whether ``target`` lacks pairs of ``source`` and was written.
    """
    with pycolmap.Database.open(source) as database:
        pairs = read_verified_pairs(database)
        keypoints = _keypoints(database)
        names = {image.image_id: image.name for image in database.read_all_images()}
    trusted = TrustedPairs(pairs, keypoints)
    trusted.trust(distinctive_pairs(pairs))
    trusted.trust({(a, b) for a, b in pairs if (names[a], names[b]) in neighbours})
    trusted.connect()
    chosen = {pair: pairs[pair] for pair in trusted.trusted}
    _keep_pairs(source, chosen, target)
    best, most = list[pycolmap.Reconstruction](), -1
    for _ in range(PASSES):
        models = run_mapper("incremental", target, total, seed)
        agreeing = len(_agreeing(models, chosen, source))
        if agreeing > most:
            best, most = models, agreeing
        if not models or most == len(chosen):
            break
        _start_at(target, models[0])
    kept = chosen | _agreeing(best, pairs, source)
    _keep_pairs(source, kept, target)
    if best:
        _start_at(target, best[0])
    return len(kept) < len(pairs)


def _agreeing(models: Sequence[pycolmap.Reconstruction], pairs: Pairs, source: Path) -> Pairs:
    """The pairs that agree with a model that has both photographs, with the matches that do."""
    found: Pairs = {}
    for model in models:
        with pycolmap.Database.open(source) as database:
            views = read_views(model, database)
        points = {point_id: point.xyz for point_id, point in model.points3D.items()}
        for pair, matches in pairs.items():
            if set(pair) <= set(views) and pair not in found:
                a, b = views[pair[0]], views[pair[1]]
                on_line = matches_agree(a, b, matches)
                forth, back = (
                    _places(a, b, matches, points),
                    _places(b, a, matches[:, ::-1], points),
                )
                is_known = np.isfinite(forth) | np.isfinite(back)
                is_right = on_line & (np.fmax(forth, back) <= SAME_PLACE)
                enough = max(MIN_KNOWN, MIN_AGREEING * is_known.sum())
                if on_line.mean() >= MIN_AGREEING_SHARE and is_right.sum() >= enough:
                    found[pair] = matches[is_right | (on_line & ~is_known)]
    return found


def _places(
    one: ModelView, other: ModelView, matches: NDArray[np.uint32], points: Mapping[int, Floats]
) -> Floats:
    """(M,) distances between the point that each keypoint of the first image observes and the
    matched keypoint of the other, as shares of its longer side; NaN where it observes none.

    Look-alikes along the camera's path obey the epipolar geometry; their points are elsewhere.
    """
    ids = one.observed[matches[:, 0]]
    distances = np.full(len(ids), np.nan)
    seen = np.flatnonzero(ids >= 0)
    if len(seen):
        xy = other.projected(np.array([points[i] for i in ids[seen].tolist()]))
        apart = np.linalg.norm(xy - other.xy[matches[seen, 1]], axis=1) / other.side
        distances[seen] = np.nan_to_num(apart, nan=np.inf)
    return distances


def _start_at(path: Path, model: pycolmap.Reconstruction) -> None:
    """Start cameras of the database that have no prior at the focal lengths of the model."""
    used = {model.image(image_id).camera_id for image_id in model.reg_image_ids()}
    with pycolmap.Database.open(path) as database:
        for camera in database.read_all_cameras():
            is_free = not camera.has_prior_focal_length and not camera.is_spherical()
            if is_free and camera.camera_id in used:
                found = model.camera(camera.camera_id)
                focal = found.mean_focal_length() / max(found.width, found.height)
                database.update_camera(uncalibrated(camera, focal))


def _keypoints(database: pycolmap.Database) -> dict[int, Floats]:
    """Image id -> (F, 2) keypoints, as shares of the longer side."""
    sides = {c.camera_id: max(c.width, c.height) for c in database.read_all_cameras()}
    return {
        image.image_id: database.read_keypoints(image.image_id)[:, :2].astype(np.float64)
        / sides[image.camera_id]
        for image in database.read_all_images()
    }


def _keep_pairs(source: Path, kept: Pairs, target: Path) -> None:
    """Copy a database with these verified matches alone."""
    shutil.copyfile(source, target)
    with pycolmap.Database.open(target) as database, pycolmap.DatabaseTransaction(database):
        for pair, matches in read_verified_pairs(database).items():
            if pair not in kept:
                database.delete_inlier_matches(*pair)
            elif len(kept[pair]) < len(matches):
                geometry = database.read_two_view_geometry(*pair)
                geometry.inlier_matches = kept[pair]
                database.update_two_view_geometry(*pair, geometry)
