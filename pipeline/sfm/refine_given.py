"""Given poses, adjusted once more to the tracks they came with.

COLMAP holds principal points in the middle of the picture by default. A lens that is centred a few
pixels off bends poses and points to make up for it, everywhere a little differently, and what is
trained from them is that much less sharp.

Imports pycolmap: not to be imported beside torch (see ``isolate``).
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.config import schema
from pipeline.geometry.similarity import robust_similarity
from pipeline.io.posefiles import pose_files
from pipeline.sfm.models import write_model
from pipeline.sfm.placement import apply
from pipeline.sfm.quiet import quiet_colmap
from pipeline.sfm.refine import Refined, adjust, adjust_points, refine

# Poses and lenses are found from the longest tracks, so many a photograph (docs/sfm.md). What to
# free shows in fewer.
TRACKS_PER_IMAGE = 1000
TRACKS_TO_DECIDE = 200
# In the end residuals beyond this many pixels count less: given tracks are mostly better than that,
# and the rest worse (bonsai: median 0.29, a tenth beyond 0.96).
LOSS_PX = 0.3
WIDE_LOSS_PX = 1.0
# Smaller than for decisions: principal points converge last.
TOLERANCE = 1e-6
# Points that the adjusted world is laid over the given one by.
ANCHORS = 5000

Tracks = list[tuple[int, list[int]]]


@dataclass(frozen=True)
class GivenReport:
    """Attributes:
    freed: the cameras changed, and all with them; else the model is as it was given.
    error_before_px, error_px: mean reprojection errors.
    decisions: for people.
    """

    freed: bool
    error_before_px: float
    error_px: float
    decisions: list[str]


def refine_given(sparse: Path, config: schema.Sfm, out: Path) -> GivenReport:
    """Adjust the model in ``sparse`` and write it to ``out``, in the world it was given in.

    A model whose cameras gain nothing from being freed is written as it was given. The same bytes
    each time: everything runs on one thread.
    """
    quiet_colmap()
    model = pycolmap.Reconstruction(sparse)
    model.update_point_3d_errors()
    before = float(model.compute_mean_reprojection_error())
    tracks = _tracks(model)
    anchors = [number for number, _ in tracks[:ANCHORS]]
    given = _positions(model, anchors)
    found = refine(
        _longest_tracks(model, tracks, TRACKS_TO_DECIDE),
        radial=config.refine_radial == "auto",
        principal_point=config.refine_principal_point,
        inner_iterations=True,
    )
    adjusted = _adjust_again(model, tracks, found) if found.freed else found.model
    if not found.freed or not _is_finite(adjusted):
        out.mkdir(parents=True, exist_ok=True)
        for file in pose_files(sparse):
            shutil.copy(file, out)
        return GivenReport(False, before, before, [*found.decisions, "poses stay as given"])
    _take_over(model, adjusted)
    adjust_points(model, loss_px=LOSS_PX, done=adjusted.point3D_ids())
    _lay_over(model, anchors, given)
    write_model(model, out)
    after = float(model.compute_mean_reprojection_error())
    told = (
        f"poses, points and lenses adjusted to the given tracks: mean reprojection error "
        f"{before:.3f} px before, {after:.3f} px now"
    )
    return GivenReport(True, before, after, [*found.decisions, told])


def _adjust_again(
    model: pycolmap.Reconstruction, tracks: Tracks, found: Refined
) -> pycolmap.Reconstruction:
    """The longest tracks of ``model`` and its cameras, adjusted from what was found with fewer."""
    thinned = _longest_tracks(model, tracks, TRACKS_PER_IMAGE)
    _take_over(thinned, found.model)
    # The cameras have moved: points must follow before a loss that gives up distant ones.
    adjust_points(thinned, loss_px=WIDE_LOSS_PX, done=found.model.point3D_ids())
    adjust(thinned, found.centres, loss_px=LOSS_PX, tolerance=TOLERANCE, inner_iterations=True)
    return thinned


def _tracks(model: pycolmap.Reconstruction) -> Tracks:
    """Point ids, each with the ids of the images of its track, longest tracks first."""
    tracks = [
        (number, [element.image_id for element in point.track.elements])
        for number, point in model.points3D.items()
    ]
    return sorted(tracks, key=lambda item: (-len(item[1]), item[0]))


def _longest_tracks(
    model: pycolmap.Reconstruction, tracks: Tracks, per_image: int
) -> pycolmap.Reconstruction:
    """A copy with the points alone that fill the images' shares, those seen by most first."""
    thinned = pycolmap.Reconstruction(model)
    missing = dict.fromkeys(thinned.reg_image_ids(), per_image)
    for number, images in tracks:
        if all(missing[image] <= 0 for image in images):
            thinned.delete_point3D(number)
        else:
            for image in images:
                missing[image] -= 1
    return thinned


def _take_over(model: pycolmap.Reconstruction, adjusted: pycolmap.Reconstruction) -> None:
    """Give ``model`` the cameras and poses of ``adjusted``, and the points that both have."""
    for number, camera in adjusted.cameras.items():
        model.cameras[number].model = camera.model
        model.cameras[number].params = camera.params
    for number, frame in adjusted.frames.items():
        model.frame(number).rig_from_world = frame.rig_from_world
    for number, point in adjusted.points3D.items():
        if model.exists_point3D(number):
            model.point3D(number).xyz = point.xyz


def _positions(model: pycolmap.Reconstruction, points: list[int]) -> NDArray[np.float64]:
    """(N, 3) positions of these points."""
    return np.stack([model.point3D(number).xyz for number in points])


def _lay_over(
    model: pycolmap.Reconstruction, anchors: list[int], before: NDArray[np.float64]
) -> None:
    """Turn, shift and scale ``model`` to where its points ``anchors`` were given."""
    now = _positions(model, anchors)
    # Smaller than any misfit that matters, so that no point is left out for less.
    floor = 1e-6 * float(np.median(np.linalg.norm(before - np.median(before, axis=0), axis=1)))
    fitted = robust_similarity(now, before, np.ones(3), floor)
    if fitted is not None:
        apply(model, fitted.similarity)


def _is_finite(model: pycolmap.Reconstruction) -> bool:
    poses = [model.image(i).cam_from_world().matrix() for i in model.reg_image_ids()]
    values = [camera.params for camera in model.cameras.values()]
    return all(np.isfinite(value).all() for value in [*poses, *values])
