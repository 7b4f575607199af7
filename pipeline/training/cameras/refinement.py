"""What of the cameras moves while the Gaussians are trained: poses, lenses, both or nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from pipeline.config.schema import Train
from pipeline.render import CameraGradients, RasterCamera
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.training.cameras.lenses import Lenses
from pipeline.training.cameras.poses import Poses


@dataclass
class MovingCameras:
    """Poses and lenses, None where they stay as they are given.

    Attributes:
        views: how many are trained on.
    """

    views: int
    poses: Poses | None
    lenses: Lenses | None

    @staticmethod
    def of(
        views: Sequence[View], gaussians: Gaussians, extent: float, config: Train
    ) -> MovingCameras:
        return MovingCameras(
            len(views),
            Poses.of(views, gaussians, extent) if config.refine_poses else None,
            Lenses.of(views) if config.refine_intrinsics else None,
        )

    @property
    def move(self) -> bool:
        return self.poses is not None or self.lenses is not None

    def camera(self, camera: RasterCamera, index: int) -> RasterCamera:
        """A view's camera, given as it was, as it is now."""
        if self.lenses is not None:
            camera = self.lenses.camera(camera, index)
        return camera if self.poses is None else self.poses.camera(camera, index)

    def step(
        self,
        index: int,
        camera: RasterCamera,
        gradients: CameraGradients,
        config: Train,
        share: Callable[[float], float],
    ) -> None:
        """Move what a view was drawn with.

        Args:
            camera: with which it was drawn.
            share: of all that may be gone, what is due now for something that this share of the
                steps looks at.
        """
        if self.poses is not None:
            self.poses.step(index, gradients, config.pose_reach * share(1 / self.views))
        if self.lenses is not None:
            due = share(self.lenses.sharing(index) / self.views)
            self.lenses.step(index, camera, gradients, config.intrinsics_reach * due)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What a checkpoint must hold."""
        poses = {} if self.poses is None else self.poses.arrays()
        return poses if self.lenses is None else poses | self.lenses.arrays()

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        for part in (self.poses, self.lenses):
            if part is not None:
                part.restore(arrays)
