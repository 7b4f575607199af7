"""Refine known poses (a COLMAP model that came with the photographs) by bundle adjustment.

COLMAP fixes principal points at the image centre by default. If the principal point is a few pixels
off, poses and points compensate for it differently across the scene, and trained scenes lose
sharpness.

Imports pycolmap and must not be imported in a process that uses torch (see ``isolate``).
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.config import settled
from pipeline.geometry.similarity import Noise, median_distance, robust_similarity
from pipeline.io.colmap import model_files
from pipeline.runtime.counters import Report
from pipeline.sfm.alignment import transform_model
from pipeline.sfm.counters import RefineCounters
from pipeline.sfm.models import quiet_colmap, write_model
from pipeline.sfm.refine import EXACT, EXACT_PX, Refined, adjust_points, bundle_adjust, refine

# Numbers of the longest tracks of each image that cameras and poses are adjusted to, and that
# decide which parameters are freed.
TRACKS_PER_IMAGE = 1000
TRACKS_TO_DECIDE = 200
# Scale of the Cauchy loss of the final adjustment, pixels: most residuals are smaller, outliers are
# larger. The wide scale is used while points follow changed cameras.
LOSS_PX = 0.3
WIDE_LOSS_PX = 1.0
# Smaller than the tolerance for decisions: principal points converge last.
TOLERANCE = 1e-6
# Number of points that align the adjusted model with the input model.
ANCHORS = 5000

Tracks = list[tuple[int, list[int]]]


def refine_known_poses(
    sparse: Path, config: settled.Sfm
) -> tuple[pycolmap.Reconstruction | None, Report[RefineCounters]]:
    """Adjust the COLMAP model in ``sparse``, in the same world frame.

    The result is deterministic: everything runs on one thread.

    Returns:
        The adjusted model, and counters and messages. None if freeing camera parameters does not
        lower the cost (see ``refine``).
    """
    quiet_colmap()
    model = pycolmap.Reconstruction(sparse)
    model.update_point_3d_errors()
    before = float(model.compute_mean_reprojection_error())
    if before < EXACT_PX:
        return None, _unchanged([EXACT], before)
    tracks = _tracks(model)
    anchors = [number for number, _ in tracks[:ANCHORS]]
    original = _positions(model, anchors)
    refined = refine(
        _longest_tracks(model, tracks, TRACKS_TO_DECIDE),
        principal_point=config.refine_principal_point,
        inner_iterations=True,
    )
    adjusted = _adjust_more_tracks(model, tracks, refined) if refined.freed else refined.model
    if not refined.freed or not _is_finite(adjusted):
        return None, _unchanged(refined.decisions, before)
    _copy_parameters(model, adjusted)
    adjust_points(model, loss_px=LOSS_PX, done=adjusted.point3D_ids())
    _align(model, anchors, original)
    after = float(model.compute_mean_reprojection_error())
    decision = (
        f"known poses, points and cameras adjusted to their tracks: mean reprojection error "
        f"{before:.3f} px before, {after:.3f} px after"
    )
    counters = RefineCounters(freed=True, error_before_px=before, error_px=after)
    return model, Report(counters, [*refined.decisions, decision])


def write_adjusted(model: pycolmap.Reconstruction | None, sparse: Path, out: Path) -> None:
    """Write the model of ``refine_known_poses`` to ``out``; None: copy the files of ``sparse``."""
    out.mkdir(parents=True, exist_ok=True)
    if model is not None:
        write_model(model, out)
    else:
        for file in model_files(sparse):
            shutil.copy(file, out)


def _unchanged(decisions: list[str], error_px: float) -> Report[RefineCounters]:
    counters = RefineCounters(freed=False, error_before_px=error_px, error_px=error_px)
    return Report(counters, [*decisions, "known poses are unchanged"])


def _adjust_more_tracks(
    model: pycolmap.Reconstruction, tracks: Tracks, refined: Refined
) -> pycolmap.Reconstruction:
    """The model with its longest tracks, adjusted; starts from the model adjusted to fewer."""
    thinned = _longest_tracks(model, tracks, TRACKS_PER_IMAGE)
    _copy_parameters(thinned, refined.model)
    # Points must follow the changed cameras first: the narrow loss would treat them as outliers.
    adjust_points(thinned, loss_px=WIDE_LOSS_PX, done=refined.model.point3D_ids())
    bundle_adjust(
        thinned,
        refined.free_principal_points,
        loss_px=LOSS_PX,
        tolerance=TOLERANCE,
        inner_iterations=True,
    )
    return thinned


def _tracks(model: pycolmap.Reconstruction) -> Tracks:
    """Point ids with the image ids of their tracks, longest tracks first."""
    tracks = [
        (number, [element.image_id for element in point.track.elements])
        for number, point in model.points3D.items()
    ]
    return sorted(tracks, key=lambda item: (-len(item[1]), item[0]))


def _longest_tracks(
    model: pycolmap.Reconstruction, tracks: Tracks, per_image: int
) -> pycolmap.Reconstruction:
    """A copy of ``model`` with the longest tracks only: about ``per_image`` for each image."""
    thinned = pycolmap.Reconstruction(model)
    missing = dict.fromkeys(thinned.reg_image_ids(), per_image)
    for number, images in tracks:
        if all(missing[image] <= 0 for image in images):
            thinned.delete_point3D(number)
        else:
            for image in images:
                missing[image] -= 1
    return thinned


def _copy_parameters(model: pycolmap.Reconstruction, adjusted: pycolmap.Reconstruction) -> None:
    """Copy cameras, poses and the common points of ``adjusted`` to ``model``."""
    for number, camera in adjusted.cameras.items():
        model.cameras[number].model = camera.model
        model.cameras[number].params = camera.params
    for number, frame in adjusted.frames.items():
        model.frame(number).rig_from_world = frame.rig_from_world
    for number, point in adjusted.points3D.items():
        if model.exists_point3D(number):
            model.point3D(number).xyz = point.xyz


def _positions(model: pycolmap.Reconstruction, points: list[int]) -> NDArray[np.float64]:
    """(N, 3) positions of the points with these ids."""
    return np.stack([model.point3D(number).xyz for number in points])


def _align(model: pycolmap.Reconstruction, anchors: list[int], before: NDArray[np.float64]) -> None:
    """Align ``model`` by a similarity so that the points ``anchors`` fit their (N, 3) positions
    ``before``."""
    now = _positions(model, anchors)
    # Lower bound on the inlier threshold, far below any relevant misfit.
    floor = 1e-6 * median_distance(before)
    fitted = robust_similarity(now, before, np.ones(3), Noise(floor, count=0, floor=floor))
    if fitted is not None:
        transform_model(model, fitted.similarity)


def _is_finite(model: pycolmap.Reconstruction) -> bool:
    poses = [model.image(i).cam_from_world().matrix() for i in model.reg_image_ids()]
    values = [camera.params for camera in model.cameras.values()]
    return all(np.isfinite(value).all() for value in [*poses, *values])
