"""Poses that move with the Gaussians, for cameras that are off by a little.

Each view's pose goes down the loss's gradient (``render.CameraGradients``) by an Adam of its own:
after each look at the view, a turn and a shift of the scene in the camera's frame are laid over the
pose. Lin et al. 2021, "BARF", and its followers do so; coarse pictures first help here, too. The
turn is about what the view sees: about the camera's centre it would be nearly the same as a shift,
and where two parameters do the same thing a gradient hardly tells them apart.
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
from pipeline.training.optimisers.per_camera_adam import RowAdam

Array = NDArray[np.float64]


@dataclass
class Poses:
    """All views' poses and their moments.

    Attributes:
        poses: (V, 4, 4) world to camera.
        pivots: (V,) how far before the camera is what the view sees, world unit.
        extent: the scene's size; shifts count in it.
        adam: (V, 6) of the turn (radians) and the shift (extents).
    """

    poses: Array
    pivots: Array
    extent: float
    adam: RowAdam = field(init=False)

    def __post_init__(self) -> None:
        self.adam = RowAdam((len(self.poses), 6))

    @staticmethod
    def of(views: Sequence[View], gaussians: Gaussians, extent: float) -> Poses:
        """The views' poses as they are, in a scene that looks like ``gaussians``."""
        means = gaussians.means.double().numpy()
        pivots = np.array([_distance(view, means, extent) for view in views])
        return Poses(np.stack([view.world_to_camera for view in views]), pivots, extent)

    def camera(self, camera: RasterCamera, index: int) -> RasterCamera:
        """A view's camera where it is now."""
        return replace(camera, world_to_camera=torch.from_numpy(self.poses[index].copy()))

    def step(self, index: int, gradients: CameraGradients, rate: float) -> None:
        """Move one view's pose; ``rate`` is radians and extents."""
        pivot = np.array([0.0, 0.0, self.pivots[index]])
        shift = gradients.translation.numpy()
        turn = gradients.rotation.numpy() - np.cross(pivot, shift)
        change = self.adam.step(index, np.concatenate([turn, shift * self.extent]), rate)
        left = rigid(change[:3], change[3:] * self.extent + pivot)
        left[:3, 3] -= (left[:3, :3] * pivot).sum(1)
        # Sums, not "@": its bits may depend on the number of threads.
        self.poses[index] = (left[:, :, None] * self.poses[index][None]).sum(1)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What a checkpoint must hold."""
        return {"pose.poses": self.poses, **self.adam.arrays("pose")}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        self.poses = arrays["pose.poses"]
        self.adam.restore("pose", arrays)


def followed(views: Sequence[View], moved: Mapping[str, Array]) -> dict[str, Array]:
    """All views' poses, (4, 4) by name, after some of them have ``moved``: the others, held out of
    training, follow the motion that is common to those, for a scene may drift as a whole.

    The motion is a turn, the mean of all cameras' (Markley et al. 2007 in matrices: the rotation
    nearest to their sum), and a shift between the means of their centres.
    """
    old = {view.name: view for view in views if view.name in moved}
    total = np.zeros((3, 3))
    before, after = np.zeros(3), np.zeros(3)
    for name, view in old.items():
        rotation = moved[name][:3, :3]
        total += np.einsum("ki,kj->ij", rotation, view.world_to_camera[:3, :3])
        before += view.centre / len(old)
        after -= np.einsum("ki,k->i", rotation, moved[name][:3, 3]) / len(old)
    u, _, vt = np.linalg.svd(total)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    turn = np.einsum("ij,jk,kl->il", u, sign, vt)
    result = {}
    for view in views:
        pose = np.eye(4)
        pose[:3, :3] = np.einsum("ij,kj->ik", view.world_to_camera[:3, :3], turn)
        centre = np.einsum("ij,j->i", turn, view.centre - before) + after
        pose[:3, 3] = -np.einsum("ij,j->i", pose[:3, :3], centre)
        result[view.name] = moved.get(view.name, pose)
    return result


def moved_by(views: Sequence[View], poses: Mapping[str, Array]) -> str:
    """How far training has moved the cameras, to these ``poses`` by name, in words."""
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
        f"cameras were moved with the scene: by {np.median(turned):.3f} degrees and {share:.2%} of "
        "the scene's extent (medians)"
    )


def _distance(view: View, means: Array, extent: float) -> float:
    """Median depth of the means (N, 3) that lie in the view, the extent if none does."""
    pose = view.world_to_camera
    cam = np.stack([(means * row[:3]).sum(1) + row[3] for row in pose[:3]], 1)
    z = np.maximum(cam[:, 2], 1e-12)
    x, y = view.fx * cam[:, 0] / z + view.cx, view.fy * cam[:, 1] / z + view.cy
    inside = (cam[:, 2] > 0) & (x >= 0) & (x <= view.width) & (y >= 0) & (y <= view.height)
    return float(np.median(cam[inside, 2])) if inside.any() else extent


def rigid(turn: Array, shift: Array) -> Array:
    """(4, 4) exp of the turn (3,), radians, by Rodrigues' formula, and then the shift (3,)."""
    angle = math.sqrt(float((turn**2).sum()))
    x, y, z = turn
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    square = np.outer(turn, turn) - angle**2 * np.eye(3)
    # sin(a) / a and (1 - cos(a)) / a^2, whose quotients lose all digits at 0
    sine = math.sin(angle) / angle if angle > 1e-4 else 1 - angle**2 / 6
    cosine = (1 - math.cos(angle)) / angle**2 if angle > 1e-4 else 0.5 - angle**2 / 24
    matrix = np.eye(4)
    matrix[:3, :3] += sine * skew + cosine * square
    matrix[:3, 3] = shift
    return matrix
