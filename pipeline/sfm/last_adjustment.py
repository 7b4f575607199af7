"""The last bundle adjustment, by the tracks and keypoints that fit best.

Residuals of SIFT keypoints have heavy tails: those of large scales and at edges of occlusion are
several times less accurate than the others, often in all photographs of a track. A Cauchy loss of
the scale of the median residual gives such keypoints little weight, and tracks with large residuals
have no influence on the poses.
"""

from __future__ import annotations

from collections.abc import Set
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.sfm.keypoint_variance import (
    RELIABLE_RESIDUALS,
    image_residuals,
    loss_scale,
    median_error,
)
from pipeline.sfm.refine import EXACT_PX, adjust_points, bundle_adjust

#: Observations with a larger reprojection error, and those behind their camera, are removed
#: (COLMAP: ``filter_max_reproj_error``).
MAX_REPROJECTION_PX = 4.0
#: Tracks are made longer and the model adjusted until this share of new tracks or fewer is found.
SETTLED, MAX_ROUNDS = 0.05, 3
#: Tracks are completed and merged with so many times the median residual, and this at least, as the
#: largest reprojection error, pixels.
TRIANGULATION_RESIDUALS, MIN_TRIANGULATION_PX = 5.0, 1.0
#: Smallest angle at which points are triangulated, degrees.
MIN_ANGLE_DEG = 0.5


def adjust_last(
    model: pycolmap.Reconstruction,
    database: Path,
    free_principal_points: Set[int] = frozenset(),
    *,
    cameras: bool = True,
) -> tuple[pycolmap.Reconstruction, str]:
    """Remove gross outliers, make tracks longer and adjust poses, points and cameras with a narrow
    robust loss. Runs on one thread.

    Args:
        model: An adjusted model, which is not changed.
        database: The database that the model was mapped from; not changed.
        free_principal_points: The ids of the cameras whose principal points are refined.
        cameras: Whether focal lengths and distortions are refined.

    Returns:
        The model and a sentence for the log.
    """
    adjusted = pycolmap.Reconstruction(model)
    removed = _remove_outliers(adjusted)
    if median_error(adjusted) < EXACT_PX:
        return adjusted, f"{removed} outliers removed; the other tracks fit exactly"
    adjust = partial(bundle_adjust, adjusted, free_principal_points, focal=cameras)
    adjust(distortion=cameras, loss_px=loss_scale(adjusted))
    for _ in range(MAX_ROUNDS):
        removed += _remove_outliers(adjusted)
        before = adjusted.num_points3D()
        _triangulate(adjusted, database)
        has_settled = adjusted.num_points3D() < (1 + SETTLED) * before
        held = _take_unreliable(adjusted)
        loss = loss_scale(adjusted)
        adjust(distortion=cameras, loss_px=loss)
        reliable = set(adjusted.point3D_ids())
        for xyz, track in held:
            adjusted.add_point3D(xyz, track)
        adjust_points(adjusted, loss_px=loss, done=reliable)
        if has_settled:
            break
    removed += _remove_outliers(adjusted)
    return adjusted, (
        f"last bundle adjustment with a Cauchy loss of {loss:.2f} px by {len(reliable)} tracks; "
        f"{len(held)} less accurate ones follow, {removed} outliers removed"
    )


def _remove_outliers(model: pycolmap.Reconstruction) -> int:
    removed = pycolmap.ObservationManager(model).filter_all_points3D(MAX_REPROJECTION_PX, 0.0)
    model.update_point_3d_errors()
    return int(removed)


def _triangulate(model: pycolmap.Reconstruction, database: Path) -> None:
    """Triangulate, complete and merge tracks by the verified matches, in place."""
    max_error_px = max(TRIANGULATION_RESIDUALS * median_error(model), MIN_TRIANGULATION_PX)
    known = pycolmap.DatabaseCacheOptions()
    # The images of the model alone; also those that were placed without verified pairs.
    known.image_names = {model.image(image_id).name for image_id in model.reg_image_ids()}
    known.load_all_images = True
    with pycolmap.Database.open(database) as opened:
        cache = pycolmap.DatabaseCache.create(opened, known)
    graph = cache.correspondence_graph
    manager = pycolmap.ObservationManager(model, graph)
    triangulator = pycolmap.IncrementalTriangulator(graph, model, manager)
    options = pycolmap.IncrementalTriangulatorOptions()
    options.random_seed = 0
    options.ignore_two_view_tracks = False
    options.min_angle = MIN_ANGLE_DEG
    options.merge_max_reproj_error = options.complete_max_reproj_error = max_error_px
    options.create_max_angle_error = options.continue_max_angle_error = MIN_ANGLE_DEG
    for image_id in sorted(model.reg_image_ids()):
        triangulator.triangulate_image(options, image_id)
    triangulator.complete_all_tracks(options)
    triangulator.merge_all_tracks(options)
    manager.filter_all_points3D(max_error_px, MIN_ANGLE_DEG)
    model.update_point_3d_errors()


def _take_unreliable(
    model: pycolmap.Reconstruction,
) -> list[tuple[NDArray[np.float64], pycolmap.Track]]:
    """Remove the tracks with large residuals from a model and return them."""
    points = {i: point.xyz for i, point in model.points3D.items()}
    ids = np.array(sorted(points), np.int64)
    found = [image_residuals(model, model.image(i), points) for i in sorted(model.reg_image_ids())]
    of_point = np.searchsorted(ids, np.concatenate([seen for seen, _ in found]))
    residuals = np.linalg.norm(np.concatenate([errors for _, errors in found]), axis=1)
    length = np.bincount(of_point, minlength=len(ids))
    squares = np.bincount(of_point, weights=residuals**2, minlength=len(ids))
    # A track of n keypoints has 2 n - 3 degrees of freedom.
    rms = np.sqrt(squares / np.maximum(length - 1.5, 0.5))
    manager = pycolmap.ObservationManager(model)
    held = []
    for point_id in ids[rms > RELIABLE_RESIDUALS * np.median(residuals)]:
        point = model.point3D(int(point_id))
        elements = [pycolmap.TrackElement(e.image_id, e.point2D_idx) for e in point.track.elements]
        held.append((point.xyz.copy(), pycolmap.Track(elements)))
        manager.delete_point3D(int(point_id))
    return held
