"""The last bundle adjustment, with more of the camera free where the geometry carries it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Set
from dataclasses import dataclass
from typing import cast

import numpy as np
import pycolmap

from pipeline.io.posefiles import MIN_IMAGES_PER_CAMERA

# A freed parameter is kept where the robust cost falls by this share at least. On real sets with
# known cameras the ones that are there gain 0.5% to 8%, the ones that are not 0.01% to 0.1%.
MIN_GAIN = 0.004
# Lenses are centred to a few per cent of the picture; beyond this the fit bends to something else.
MAX_SHIFT = 0.06
# Tracks that fit better than this, in pixels, were made by these very cameras.
EXACT_PX = 0.01
FUNCTION_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Refined:
    """Attributes:
    model: adjusted.
    freed: more of its cameras is free than before.
    centres: ids of the cameras whose principal points are free.
    decisions: for people.
    """

    model: pycolmap.Reconstruction
    freed: bool
    centres: Set[int]
    decisions: list[str]


def refine(
    model: pycolmap.Reconstruction,
    *,
    radial: bool,
    principal_point: str,
    inner_iterations: bool = False,
) -> Refined:
    """Adjust all of the model once more, robustly, and free more of its cameras step by step as
    long as that pays: a second radial term, then the principal point.

    Args:
        model: not changed.
        radial: cameras may turn from SIMPLE_RADIAL to RADIAL.
        principal_point: "yes", "no", or "auto" (where it pays).
        inner_iterations: see ``adjust``.
    """
    rich = _rich_cameras(model)
    best = pycolmap.Reconstruction(model)
    cost = adjust(best, inner_iterations=inner_iterations)
    # Ceres halves the squares.
    if np.sqrt(2 * cost / max(best.compute_num_observations(), 1)) < EXACT_PX:
        return Refined(best, False, set(), ["the tracks fit exactly: there is nothing to free"])
    decisions: list[str] = []
    freed, centres = False, set[int]()
    if not rich:
        if principal_point == "yes":
            rich = set(model.cameras)
        else:
            text = (
                f"no camera has {MIN_IMAGES_PER_CAMERA} photographs: distortion and principal "
                "points stay fixed"
            )
            return Refined(best, False, set(), [text])
    if radial and any(model.camera(i).model_name == "SIMPLE_RADIAL" for i in rich):
        freer = pycolmap.Reconstruction(best)
        for camera_id in rich:
            _make_radial(freer.camera(camera_id))
        freer_cost = adjust(freer, inner_iterations=inner_iterations)
        gain = 1 - freer_cost / max(cost, 1e-12)
        kept = gain >= MIN_GAIN
        decisions.append(
            f"camera model {'RADIAL' if kept else 'SIMPLE_RADIAL'}: a second radial term lowers "
            f"the cost by {gain:.2%}"
        )
        if kept:
            best, cost, freed = freer, freer_cost, True
    if principal_point != "no":
        freer = pycolmap.Reconstruction(best)
        freer_cost = adjust(freer, rich, inner_iterations=inner_iterations)
        gain, shift = 1 - freer_cost / max(cost, 1e-12), _largest_shift(best, freer, rich)
        kept = principal_point == "yes" or (gain >= MIN_GAIN and shift <= MAX_SHIFT)
        decisions.append(
            f"principal point {'freed' if kept else 'held'}: freeing it lowers the cost by "
            f"{gain:.2%} and moves it by {shift:.1%} of the longer side"
        )
        if kept:
            best, freed, centres = freer, True, rich
    return Refined(best, freed, centres, decisions)


def adjust(
    model: pycolmap.Reconstruction,
    free_principal_point: Set[int] = frozenset(),
    *,
    loss_px: float = 1.0,
    tolerance: float = FUNCTION_TOLERANCE,
    inner_iterations: bool = False,
) -> float:
    """Robust bundle adjustment of everything, with the principal points of those cameras; returns
    the final cost.

    Residuals beyond ``loss_px`` pixels count less (Cauchy's loss). It ends with the first step
    that lowers the cost by no more than the share ``tolerance``.

    ``inner_iterations``: points, poses and cameras are adjusted one by one after each step, where
    that has one order. A robust loss makes steps short; so a third as many are needed. It pays for
    long tracks, whose steps cost most.
    """
    options = _options(loss_px, tolerance)
    options.refine_principal_point = bool(free_principal_point)
    if inner_iterations and _has_one_block_order(model):
        options.ceres.solver_options.use_inner_iterations = True
        # No damping: such steps are good, and principal points lag behind.
        options.ceres.solver_options.initial_trust_region_radius = 1e8
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    if free_principal_point:
        # pycolmap frees the principal points of all cameras or of none: hold the poor ones whole.
        for camera_id in sorted(set(model.cameras) - free_principal_point):
            config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return _solve(options, config, model)


def adjust_points(
    model: pycolmap.Reconstruction, *, loss_px: float, done: Set[int] = frozenset()
) -> None:
    """The same for the points alone, between cameras that stay.

    ``done``: ids of points that ``adjust`` has moved with these cameras and this loss: they are
    at their minimum.
    """
    options = _options(loss_px, FUNCTION_TOLERANCE)
    options.refine_focal_length = False
    options.refine_extra_params = False
    options.refine_rig_from_world = False
    # Points do not depend on each other: inner iterations bring each to its end in one step, which
    # undamped does not stop short.
    options.ceres.solver_options.use_inner_iterations = True
    options.ceres.solver_options.max_num_iterations = 1
    options.ceres.solver_options.initial_trust_region_radius = 1e8
    config = pycolmap.BundleAdjustmentConfig()
    # Without its images: pycolmap then takes no derivatives by their poses.
    for point_id in sorted(model.point3D_ids() - done):
        config.add_variable_point(point_id)
    if config.num_points():
        _solve(options, config, model)
    else:
        model.update_point_3d_errors()


def _options(loss_px: float, tolerance: float) -> pycolmap.BundleAdjustmentOptions:
    """On one thread: on more, Ceres sums the residuals in the order they come."""
    options = pycolmap.BundleAdjustmentOptions(
        refine_principal_point=False,
        print_summary=False,
    )
    ceres = options.ceres
    ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    ceres.loss_function_scale = loss_px
    ceres.solver_options.num_threads = 1
    ceres.solver_options.function_tolerance = tolerance
    return options


def _solve(
    options: pycolmap.BundleAdjustmentOptions,
    config: pycolmap.BundleAdjustmentConfig,
    model: pycolmap.Reconstruction,
) -> float:
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    summary = cast(pycolmap.CeresBundleAdjustmentSummary, adjuster.solve())
    model.update_point_3d_errors()
    return float(summary.ceres_summary.final_cost)


def _has_one_block_order(model: pycolmap.Reconstruction) -> bool:
    """True where Ceres's inner iterations have one order: all points, all poses, all cameras.

    Ceres takes the blocks with the fewest neighbours first, and of equal ones the one that lies
    first in memory, which changes from run to run. So each camera must have more poses than each
    pose has cameras (one pose is fixed), and each image more points than any point has images and
    cameras.
    """
    images = [model.image(i) for i in model.reg_image_ids()]
    poses = Counter(image.camera_id for image in images)
    longest = max((point.track.length() for point in model.points3D.values()), default=0)
    fewest = min((image.num_points3D for image in images), default=0)
    neighbours = longest + min(longest, len(poses))
    return min(poses.values(), default=0) >= 3 and fewest > neighbours


def _rich_cameras(model: pycolmap.Reconstruction) -> set[int]:
    """Ids of the cameras with enough registered images."""
    used = [model.image(i).camera_id for i in model.reg_image_ids()]
    return {camera_id for camera_id in used if used.count(camera_id) >= MIN_IMAGES_PER_CAMERA}


def _make_radial(camera: pycolmap.Camera) -> None:
    if camera.model_name == "SIMPLE_RADIAL":
        focal, cx, cy, k = camera.params
        camera.model = pycolmap.CameraModelId.RADIAL
        camera.params = [focal, cx, cy, k, 0.0]


def _largest_shift(
    held: pycolmap.Reconstruction, free: pycolmap.Reconstruction, cameras: set[int]
) -> float:
    """The farthest that a principal point moved, over the longer side."""
    shifts = []
    for camera_id in cameras:
        before, after = held.camera(camera_id), free.camera(camera_id)
        move = np.hypot(
            after.principal_point_x - before.principal_point_x,
            after.principal_point_y - before.principal_point_y,
        )
        shifts.append(move / max(before.width, before.height))
    return float(max(shifts))
