"""Refinement of poses during training (as in BARF, Lin et al. 2021).

After each step, the pose of its view is changed by a rotation and a translation in the camera's
frame, by Adam on the gradient of the loss (``render.CameraGradients``). The rotation is about the
centre of what the view sees: about the camera's centre it would be nearly the same as a
translation, and gradients hardly separate two such parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.render import CameraGradients, RasterCamera
from pipeline.scene.views import View, scene_extent
from pipeline.splats.gaussians import Gaussians
from pipeline.training.optimisers.per_camera_adam import PerCameraAdam

Array = NDArray[np.float64]


@dataclass
class PoseRefinement:
    """Refined poses of the training views.

    Attributes:
        poses: (V, 4, 4) world to camera.
        pivots: (V,) depth of the centre of rotation in the camera's frame, world units.
        extent: The unit of translations (``scene.views.scene_extent``), world units.
        limit: The upper limit of a pose's total change, in radians and extents.
        adam: (V, 6) moments of the rotation (radians) and the translation (extents).
    """

    poses: Array
    pivots: Array
    extent: float
    limit: float
    adam: PerCameraAdam = field(init=False)

    def __post_init__(self) -> None:
        self.adam = PerCameraAdam((len(self.poses), 6))

    @staticmethod
    def of(
        views: Sequence[View], gaussians: Gaussians, extent: float, limit: float
    ) -> PoseRefinement:
        """The given poses; ``gaussians`` determine the centres of rotation."""
        means = gaussians.means.double().numpy()
        pivots = np.array([_median_depth(view, means, extent) for view in views])
        poses = np.stack([view.world_to_camera for view in views])
        return PoseRefinement(poses, pivots, extent, limit)

    def camera(self, camera: RasterCamera, index: int) -> RasterCamera:
        """The camera of a view with its refined pose."""
        return replace(camera, world_to_camera=torch.from_numpy(self.poses[index].copy()))

    def step(self, index: int, gradients: CameraGradients, rate: float) -> None:
        """Refine the pose of a view; ``rate`` is in radians and extents."""
        pivot = np.array([0.0, 0.0, self.pivots[index]])
        shift = gradients.translation.numpy()
        turn = gradients.rotation.numpy() - np.cross(pivot, shift)
        change = self.adam.step(index, np.concatenate([turn, shift * self.extent]), rate)
        left = rigid(change[:3], change[3:] * self.extent + pivot)
        left[:3, 3] -= (left[:3, :3] * pivot).sum(1)
        # Avoid a matrix product: BLAS may round differently with the number of threads.
        self.poses[index] = (left[:, :, None] * self.poses[index][None]).sum(1)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of a checkpoint."""
        return {"pose.poses": self.poses, **self.adam.arrays("pose")}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        self.poses = arrays["pose.poses"]
        self.adam.restore("pose", arrays)


def with_common_motion(views: Sequence[View], refined: Mapping[str, Array]) -> dict[str, Array]:
    """(4, 4) poses of all views by name: the ``refined`` ones, and for the others, the test views,
    the given pose moved like the refined ones on average, since a scene can drift as a whole.

    The average motion is a rotation, the mean of all cameras' (Markley et al. 2007 in matrices: the
    rotation nearest to their sum), and the translation between the means of their centres.
    """
    old = {view.name: view for view in views if view.name in refined}
    total = np.zeros((3, 3))
    before, after = np.zeros(3), np.zeros(3)
    for name, view in old.items():
        rotation = refined[name][:3, :3]
        total += np.einsum("ki,kj->ij", rotation, view.world_to_camera[:3, :3])
        before += view.centre / len(old)
        after -= np.einsum("ki,k->i", rotation, refined[name][:3, 3]) / len(old)
    u, _, vt = np.linalg.svd(total)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    turn = np.einsum("ij,jk,kl->il", u, sign, vt)
    result = {}
    for view in views:
        pose = np.eye(4)
        pose[:3, :3] = np.einsum("ij,kj->ik", view.world_to_camera[:3, :3], turn)
        centre = np.einsum("ij,j->i", turn, view.centre - before) + after
        pose[:3, 3] = -np.einsum("ij,j->i", pose[:3, :3], centre)
        result[view.name] = refined.get(view.name, pose)
    return result


def describe_poses(views: Sequence[View], poses: Mapping[str, Array]) -> str:
    """A sentence on the change from the views' given poses to ``poses`` by name."""
    turned, shifted = [], []
    for view in views:
        if view.name in poses:
            now, before = poses[view.name], view.world_to_camera
            cosine = ((now[:3, :3] * before[:3, :3]).sum() - 1) / 2
            turned.append(float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))
            centre = -(now[:3, :3] * now[:3, 3:]).sum(0)
            shifted.append(float(np.linalg.norm(centre - view.centre)))
    share = np.median(shifted) / scene_extent(list(views))
    return (
        f"poses were refined: by {np.median(turned):.3f} degrees and {share:.2%} of the scene's "
        "extent (medians)"
    )


def _median_depth(view: View, means: Array, extent: float) -> float:
    """Median depth of the means (N, 3) inside the view, or the extent if there are none."""
    pose = view.world_to_camera
    cam = np.stack([(means * row[:3]).sum(1) + row[3] for row in pose[:3]], 1)
    z = np.maximum(cam[:, 2], 1e-12)
    x, y = view.fx * cam[:, 0] / z + view.cx, view.fy * cam[:, 1] / z + view.cy
    inside = (cam[:, 2] > 0) & (x >= 0) & (x <= view.width) & (y >= 0) & (y <= view.height)
    return float(np.median(cam[inside, 2])) if inside.any() else extent


def rigid(turn: Array, shift: Array) -> Array:
    """(4, 4) rotation vector ``turn`` (3,), radians (Rodrigues' formula), then ``shift`` (3,)."""
    angle = math.sqrt(float((turn**2).sum()))
    x, y, z = turn
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    square = np.outer(turn, turn) - angle**2 * np.eye(3)
    # sin(a) / a and (1 - cos(a)) / a^2; by their series near 0, where the quotients lose digits
    sine = math.sin(angle) / angle if angle > 1e-4 else 1 - angle**2 / 6
    cosine = (1 - math.cos(angle)) / angle**2 if angle > 1e-4 else 0.5 - angle**2 / 24
    matrix = np.eye(4)
    matrix[:3, :3] += sine * skew + cosine * square
    matrix[:3, 3] = shift
    return matrix
