"""Final bundle adjustment, which frees more camera parameters if the data supports them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Set
from dataclasses import dataclass
from typing import cast

import numpy as np
import pycolmap

from pipeline.io.posefiles import MIN_IMAGES_PER_CAMERA
from pipeline.sfm.freed_parameters import free_parameters

# Below this RMS reprojection error the observations are projections by these cameras (synthetic).
EXACT_PX = 0.01
EXACT = "the tracks fit exactly: nothing is refined"
FUNCTION_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Refined:
    """Result of ``refine``.

    Attributes:
        model: The adjusted model.
        freed: Whether any camera parameter was freed.
        free_principal_points: The ids of the cameras whose principal points were freed.
        decisions: The sentences for the log.
    """

    model: pycolmap.Reconstruction
    freed: bool
    free_principal_points: Set[int]
    decisions: list[str]


def refine(
    model: pycolmap.Reconstruction,
    *,
    principal_point: str,
    inner_iterations: bool = False,
) -> Refined:
    """Robust bundle adjustment of a whole model, then of more camera parameters: a second radial
    distortion term, then the principal point. They are accepted for each camera by itself, if they
    lower the cost of its observations enough.

    Only cameras with enough images are freed.

    Args:
        model: The model, which is not changed.
        principal_point: "yes" (always freed), "no", or "if_determined" (if it lowers the cost).
        inner_iterations: Whether ``bundle_adjust`` uses them.
    """
    adjustable = {i for i, camera in model.cameras.items() if not camera.is_spherical()}
    images = Counter(model.image(i).camera_id for i in model.reg_image_ids())
    shared = {i for i in adjustable if images[i] >= MIN_IMAGES_PER_CAMERA}
    best = pycolmap.Reconstruction(model)
    cost = bundle_adjust(best, inner_iterations=inner_iterations)
    # Ceres' cost is half of the sum of squares.
    is_exact = np.sqrt(2 * cost / max(best.compute_num_observations(), 1)) < EXACT_PX
    unchanged = EXACT if is_exact else None
    if not is_exact and not adjustable:
        unchanged = "panoramas have no intrinsics to refine"
    elif not is_exact and not shared and principal_point != "yes":
        unchanged = (
            f"no camera has {MIN_IMAGES_PER_CAMERA} photographs: distortion models and principal "
            "points are unchanged"
        )
    if unchanged is not None:
        return Refined(best, False, set(), [unchanged])
    shared = shared or adjustable

    def with_radial(trial: pycolmap.Reconstruction, cameras: Set[int]) -> float:
        for camera_id in cameras:
            _make_radial(trial.camera(camera_id))
        return bundle_adjust(trial, inner_iterations=inner_iterations)

    def with_principal_points(trial: pycolmap.Reconstruction, cameras: Set[int]) -> float:
        return bundle_adjust(trial, cameras, inner_iterations=inner_iterations)

    decisions: list[str] = []
    freed, free_principal_points = False, set[int]()
    simple = {i for i in shared if model.camera(i).model_name == "SIMPLE_RADIAL"}
    if simple:
        trial = free_parameters(best, cost, simple, with_radial)
        decisions.append(
            f"camera model {'RADIAL' if trial.accepted else 'SIMPLE_RADIAL'}{trial.which}: a "
            f"second radial term lowers the cost by {trial.gain:.2%}"
        )
        if trial.accepted:
            best, cost, freed = trial.model, trial.cost, True
    if principal_point != "no":
        trial = free_parameters(
            best, cost, shared, with_principal_points, always=principal_point == "yes"
        )
        decisions.append(
            f"principal point {'refined' if trial.accepted else 'fixed'}{trial.which}: refining it "
            f"lowers the cost by {trial.gain:.2%} and moves it by {trial.shift:.1%} of the longer "
            "side"
        )
        if trial.accepted:
            best, freed, free_principal_points = trial.model, True, trial.accepted
    return Refined(best, freed, free_principal_points, decisions)


def bundle_adjust(
    model: pycolmap.Reconstruction,
    free_principal_point: Set[int] = frozenset(),
    *,
    focal: bool = True,
    distortion: bool = True,
    loss_px: float = 1.0,
    tolerance: float = FUNCTION_TOLERANCE,
    inner_iterations: bool = False,
) -> float:
    """Robust bundle adjustment of points, poses and cameras, in place.

    Args:
        free_principal_point: The ids of cameras whose principal points are refined. If any, the
            intrinsics of all other cameras are constant.
        focal, distortion: Whether focal lengths and distortions are refined.
        loss_px: The scale of the Cauchy loss, pixels.
        tolerance: The relative decrease of the cost at which the solver stops (Ceres'
            ``function_tolerance``).
        inner_iterations: Use Ceres' inner iterations (block coordinate descent after each step) if
            their order is unique. They need about a third of the steps and pay for long tracks.

    Returns:
        The final cost.
    """
    options = _options(loss_px, tolerance)
    options.refine_focal_length, options.refine_extra_params = focal, distortion
    options.refine_principal_point = bool(free_principal_point)
    if inner_iterations and _block_order_is_unique(model):
        options.ceres.solver_options.use_inner_iterations = True
        # Hardly any damping: principal points converge faster.
        options.ceres.solver_options.initial_trust_region_radius = 1e8
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    if free_principal_point:
        # pycolmap refines the principal points of all cameras or of none: fix the other cameras.
        for camera_id in sorted(set(model.cameras) - free_principal_point):
            config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return _solve(options, config, model)


def adjust_points(
    model: pycolmap.Reconstruction, *, loss_px: float, done: Set[int] = frozenset()
) -> None:
    """Adjust the points of a model in place; cameras and poses are fixed.

    Args:
        loss_px: The scale of the Cauchy loss, pixels.
        done: The ids of points to skip: ``bundle_adjust`` has adjusted them with these cameras and
            this loss.
    """
    options = _options(loss_px, FUNCTION_TOLERANCE)
    options.refine_focal_length = False
    options.refine_extra_params = False
    options.refine_rig_from_world = False
    # Points are independent: inner iterations solve each in one step without damping.
    options.ceres.solver_options.use_inner_iterations = True
    options.ceres.solver_options.max_num_iterations = 1
    options.ceres.solver_options.initial_trust_region_radius = 1e8
    config = pycolmap.BundleAdjustmentConfig()
    # The config has no images: pycolmap then computes no derivatives by poses.
    for point_id in sorted(model.point3D_ids() - done):
        config.add_variable_point(point_id)
    if config.num_points():
        _solve(options, config, model)
    else:
        model.update_point_3d_errors()


def _options(loss_px: float, tolerance: float) -> pycolmap.BundleAdjustmentOptions:
    """Options of Ceres, on one thread: with more, the order of summation is not fixed."""
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


def _block_order_is_unique(model: pycolmap.Reconstruction) -> bool:
    """Whether the block order of Ceres' inner iterations is unique: points, poses, cameras.

    Ceres orders parameter blocks by their number of neighbours, and blocks with equally many by
    their address, which differs from run to run. The order is unique if each camera has more poses
    than each pose has cameras (one pose is fixed), and each image has more points than any point
    has images and cameras.
    """
    images = [model.image(i) for i in model.reg_image_ids()]
    poses = Counter(image.camera_id for image in images)
    longest = max((point.track.length() for point in model.points3D.values()), default=0)
    fewest = min((image.num_points3D for image in images), default=0)
    neighbours = longest + min(longest, len(poses))
    return min(poses.values(), default=0) >= 3 and fewest > neighbours


def _make_radial(camera: pycolmap.Camera) -> None:
    if camera.model_name == "SIMPLE_RADIAL":
        focal, cx, cy, k = camera.params
        camera.model = pycolmap.CameraModelId.RADIAL
        camera.params = [focal, cx, cy, k, 0.0]
