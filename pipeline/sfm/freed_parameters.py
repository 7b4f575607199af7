"""Freeing parameters of the cameras whose own observations support it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Set
from dataclasses import dataclass

import numpy as np
import pycolmap

from pipeline.sfm.keypoint_variance import image_residuals
from pipeline.sfm.uncertainty import camera_deviations

# Smallest relative decrease of the robust cost for which a freed parameter is accepted. Parameters
# that the camera has lower the cost by at least 0.5%, others by at most 0.1%.
MIN_GAIN = 0.004
# A parameter that the camera lacks lowers the cost by about that of one residual: a camera with few
# observations needs a decrease by at least this number of residuals.
CHANCE = 10.0
# Smallest change of a parameter of one of several cameras, in standard deviations.
SIGNIFICANT = 3.0
# Largest accepted shift of the principal point over the longer side: lenses are centred to a few
# per cent of the image, and a larger shift compensates for other errors.
MAX_SHIFT = 0.06


@dataclass(frozen=True)
class Trial:
    """A model with freed parameters.

    Attributes:
        cost: The cost of the model.
        accepted: The ids of the cameras for which the parameters are accepted.
        which: The number of these for the log; empty if they are all or none.
        gain: The relative decrease of the cost.
        shift: The largest shift of a principal point, over the longer side.
    """

    model: pycolmap.Reconstruction
    cost: float
    accepted: set[int]
    which: str
    gain: float
    shift: float


def free_parameters(
    model: pycolmap.Reconstruction,
    cost: float,
    cameras: set[int],
    free: Callable[[pycolmap.Reconstruction, Set[int]], float],
    *,
    always: bool = False,
) -> Trial:
    """Free parameters of those cameras whose own observations support it.

    Args:
        cost: The cost of ``model``.
        cameras: The ids of the cameras for which it is tried.
        free: Frees parameters of cameras of a model, adjusts it, and returns the cost.
        always: Whether the parameters are accepted in any case.
    """
    trial = pycolmap.Reconstruction(model)
    trial_cost = free(trial, cameras)
    before, after = _camera_costs(model, cost), _camera_costs(trial, trial_cost)
    accepted = {
        i
        for i in cameras
        if always
        or (
            before[i].decrease(after[i]) >= max(MIN_GAIN, CHANCE / before[i].residuals)
            and _largest_shift(model, trial, {i}) <= MAX_SHIFT
        )
    }
    if len(before) > 1 and not always:
        # Where one camera gets what it has, the observations of the others fit better as well.
        accepted &= _changed(model, trial)
    if accepted and accepted != cameras:
        trial = pycolmap.Reconstruction(model)
        trial_cost = free(trial, accepted)
    return Trial(
        trial,
        trial_cost,
        accepted,
        f" of {len(accepted)} of {len(cameras)} cameras"
        if 0 < len(accepted) < len(cameras)
        else "",
        1 - trial_cost / max(cost, 1e-12),
        _largest_shift(model, trial, accepted or cameras),
    )


def _changed(model: pycolmap.Reconstruction, trial: pycolmap.Reconstruction) -> set[int]:
    """The ids of the cameras of which a freed parameter differs by more than its uncertainty."""
    changed = set()
    for camera_id, deviations in camera_deviations(trial).items():
        camera, given = trial.camera(camera_id), model.camera(camera_id)
        freed = set(camera.principal_point_idxs())
        if camera.model_name != given.model_name:
            freed = set(range(len(given.params), len(camera.params)))
        for index in sorted(freed & deviations.keys()):
            before = given.params[index] if index < len(given.params) else 0.0
            if abs(camera.params[index] - before) > SIGNIFICANT * deviations[index]:
                changed.add(camera_id)
    return changed


@dataclass(frozen=True)
class _Cost:
    """The cost of the observations of a camera, and the number of their residuals."""

    cost: float
    residuals: int

    def decrease(self, after: _Cost) -> float:
        """The relative decrease of the cost."""
        return 1 - after.cost / max(self.cost, 1e-12)


def _camera_costs(model: pycolmap.Reconstruction, total: float) -> dict[int, _Cost]:
    """Camera id -> its part of the cost of a model, which is ``total``, with a loss of 1 pixel."""
    images = [model.image(i) for i in sorted(model.reg_image_ids())]
    if len({image.camera_id for image in images}) == 1:
        residuals = 2 * int(model.compute_num_observations())
        return {images[0].camera_id: _Cost(total, max(residuals, 1))}
    costs, residuals_of = dict[int, float](), Counter[int]()
    points = {i: point.xyz for i, point in model.points3D.items()}
    for image in images:
        squares = (image_residuals(model, image, points)[1] ** 2).sum(1)
        # Cauchy's loss; Ceres' cost is half of the sum.
        cost = float(np.nansum(np.log1p(squares)) / 2)
        costs[image.camera_id] = costs.get(image.camera_id, 0.0) + cost
        residuals_of[image.camera_id] += 2 * len(squares)
    return {i: _Cost(costs[i], max(residuals_of[i], 1)) for i in costs}


def _largest_shift(
    fixed: pycolmap.Reconstruction, refined: pycolmap.Reconstruction, cameras: set[int]
) -> float:
    """Largest shift of a principal point, over the longer side."""
    shifts = []
    for camera_id in cameras:
        before, after = fixed.camera(camera_id), refined.camera(camera_id)
        move = np.hypot(
            after.principal_point_x - before.principal_point_x,
            after.principal_point_y - before.principal_point_y,
        )
        shifts.append(move / max(before.width, before.height))
    return float(max(shifts))
