"""Focal lengths and principal points that move with the Gaussians, for lenses that are off by a
little. A camera's are shared by all its views, the held-out ones included."""

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
from pipeline.training.optimisers.per_camera_adam import RowAdam

Array = NDArray[np.float64]


@dataclass
class Lenses:
    """What the cameras' lenses differ by from what was given.

    Attributes:
        ids: (C,) the cameras' numbers, ascending.
        row: (V,) each view's camera as its place in ``ids``.
        change: (C, 3) logarithm of the factor of both focal lengths, and the principal point's
            shift across and down, both in units of the given focal length in x, so that a
            picture's size does not matter.
        adam: (C, 3) of the change.
    """

    ids: list[int]
    row: NDArray[np.int64]
    change: Array = field(init=False)
    adam: RowAdam = field(init=False)

    def __post_init__(self) -> None:
        self.change = np.zeros((len(self.ids), 3))
        self.adam = RowAdam((len(self.ids), 3))

    @staticmethod
    def of(views: Sequence[View]) -> Lenses:
        ids, row = np.unique([view.camera_id for view in views], return_inverse=True)
        return Lenses(ids.tolist(), row.astype(np.int64))

    def camera(self, camera: RasterCamera, index: int) -> RasterCamera:
        """A view's camera, given as it was, with its lens as it is now."""
        fx, fy, cx, cy = adjusted(
            (camera.fx, camera.fy, camera.cx, camera.cy), self.change[self.row[index]]
        )
        return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy)

    def sharing(self, index: int) -> int:
        """How many views a view's camera took."""
        return int((self.row == self.row[index]).sum())

    def step(
        self, index: int, camera: RasterCamera, gradients: CameraGradients, rate: float
    ) -> None:
        """Move one view's lens; ``camera`` is what was drawn with, ``rate`` in logarithms of the
        focal length."""
        row = int(self.row[index])
        d_fx, d_fy = gradients.focal.tolist()
        d_cx, d_cy = gradients.principal.tolist()
        given = camera.fx / float(np.exp(self.change[row, 0]))
        gradient = np.array([d_fx * camera.fx + d_fy * camera.fy, d_cx * given, d_cy * given])
        self.change[row] += self.adam.step(row, gradient, rate)

    def by_id(self) -> dict[int, Array]:
        return dict(zip(self.ids, self.change, strict=True))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What a checkpoint must hold."""
        return {"lens.change": self.change, **self.adam.arrays("lens")}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        self.change = arrays["lens.change"]
        self.adam.restore("lens", arrays)


def adjusted(
    pinhole: tuple[float, float, float, float], change: Array
) -> tuple[float, float, float, float]:
    """(fx, fy, cx, cy) after a change as in ``Lenses``."""
    fx, fy, cx, cy = pinhole
    factor, across, down = float(np.exp(change[0])), float(change[1]), float(change[2])
    return fx * factor, fy * factor, cx + fx * across, cy + fx * down


def with_lenses(model: Reconstruction, changes: Mapping[int, Array]) -> Reconstruction:
    """The model with its cameras' lenses changed, by id; those not named stay, and those named
    must be pinholes."""

    def changed(key: int, camera: Camera) -> Camera:
        if key not in changes:
            return camera
        params = np.array(adjusted(camera.pinhole, changes[key]))
        return Camera("PINHOLE", camera.width, camera.height, params)

    return replace(model, cameras={key: changed(key, c) for key, c in model.cameras.items()})


def changed_by(changes: Mapping[int, Array]) -> str:
    """How far training has changed the lenses, in words."""
    factors = np.exp([change[0] for change in changes.values()])
    shifts = [float(np.hypot(change[1], change[2])) for change in changes.values()]
    return (
        f"lenses were adjusted with the scene: focal lengths times {min(factors):.4f} to "
        f"{max(factors):.4f}, principal points moved by up to {max(shifts):.2%} of the focal length"
    )
