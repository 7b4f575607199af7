"""Refinement of focal lengths and principal points during training.

All views of a camera share its intrinsics, test views included.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.render import CameraGradients, RasterCamera
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View
from pipeline.training.optimisers.per_camera_adam import PerCameraAdam

Array = NDArray[np.float64]


@dataclass
class IntrinsicsRefinement:
    """Changes of the intrinsics.

    Attributes:
        ids: (C,) ids of the cameras, ascending.
        camera_of: (V,) index of each view's camera in ``ids``.
        limit: The upper limit of the total change, in focal lengths.
        change: (C, 3) logarithm of the factor of both focal lengths, and the shift of the principal
            point in x and y, in units of the given focal length in x, which do not depend on the
            size of the image.
        adam: (C, 3) moments of the change.
    """

    ids: list[int]
    camera_of: NDArray[np.int64]
    limit: float
    change: Array = field(init=False)
    adam: PerCameraAdam = field(init=False)

    def __post_init__(self) -> None:
        self.change = np.zeros((len(self.ids), 3))
        self.adam = PerCameraAdam((len(self.ids), 3))

    @staticmethod
    def of(views: Sequence[View], limit: float) -> IntrinsicsRefinement:
        ids, camera_of = np.unique([view.camera_id for view in views], return_inverse=True)
        return IntrinsicsRefinement(ids.tolist(), camera_of.astype(np.int64), limit)

    def camera(self, camera: RasterCamera, index: int) -> RasterCamera:
        """The camera of a view with refined intrinsics, from the given one."""
        fx, fy, cx, cy = adjusted(
            (camera.fx, camera.fy, camera.cx, camera.cy), self.change[self.camera_of[index]]
        )
        return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy)

    def num_sharing(self, index: int) -> int:
        """The number of views that share the camera of a view."""
        return int((self.camera_of == self.camera_of[index]).sum())

    def step(
        self, index: int, camera: RasterCamera, gradients: CameraGradients, rate: float
    ) -> None:
        """Refine the camera of a view.

        Args:
            camera: The refined camera that the view was rendered with.
            rate: The learning rate, in focal lengths.
        """
        own = int(self.camera_of[index])
        d_fx, d_fy = gradients.focal.tolist()
        d_cx, d_cy = gradients.principal.tolist()
        given = camera.fx / float(np.exp(self.change[own, 0]))
        gradient = np.array([d_fx * camera.fx + d_fy * camera.fy, d_cx * given, d_cy * given])
        self.change[own] += self.adam.step(own, gradient, rate)

    def by_id(self) -> dict[int, Array]:
        """(3,) change of each camera by its id."""
        return dict(zip(self.ids, self.change, strict=True))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of a checkpoint."""
        return {"intrinsics.change": self.change, **self.adam.arrays("intrinsics")}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        self.change = arrays["intrinsics.change"]
        self.adam.restore("intrinsics", arrays)


def adjusted(
    pinhole: tuple[float, float, float, float], change: Array
) -> tuple[float, float, float, float]:
    """(fx, fy, cx, cy) after a change (3,) as in ``IntrinsicsRefinement``."""
    fx, fy, cx, cy = pinhole
    factor, across, down = float(np.exp(change[0])), float(change[1]), float(change[2])
    return fx * factor, fy * factor, cx + fx * across, cy + fx * down


def with_intrinsics(model: Reconstruction, changes: Mapping[int, Array]) -> Reconstruction:
    """The model with changed intrinsics of the cameras with these ids, which must be pinholes."""

    def changed(key: int, camera: Camera) -> Camera:
        if key not in changes:
            return camera
        params = np.array(adjusted(camera.pinhole, changes[key]))
        return Camera("PINHOLE", camera.width, camera.height, params)

    return replace(model, cameras={key: changed(key, c) for key, c in model.cameras.items()})


def describe_intrinsics(changes: Mapping[int, Array]) -> str:
    """A sentence on the range of the changes."""
    factors = np.exp([change[0] for change in changes.values()])
    shifts = [float(np.hypot(change[1], change[2])) for change in changes.values()]
    return (
        f"intrinsics were refined: focal lengths times {min(factors):.4f} to {max(factors):.4f}, "
        f"principal points moved by up to {max(shifts):.2%} of the focal length"
    )
