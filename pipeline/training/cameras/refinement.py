"""Camera refinement during training: poses, intrinsics, both or neither."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from pipeline.config.settled import TrainOptions
from pipeline.render import CameraGradients, RasterCamera
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.training.cameras.intrinsics import IntrinsicsRefinement
from pipeline.training.cameras.poses import PoseRefinement


@dataclass
class CameraRefinement:
    """The refined cameras of the training views.

    Attributes:
        num_views: The number of training views.
        poses: None if poses are not refined.
        intrinsics: None if intrinsics are not refined.
    """

    num_views: int
    poses: PoseRefinement | None
    intrinsics: IntrinsicsRefinement | None

    @staticmethod
    def of(
        views: Sequence[View],
        gaussians: Gaussians,
        extent: float,
        options: TrainOptions,
    ) -> CameraRefinement:
        """The given cameras, refined as ``options`` say.

        Args:
            extent: ``scene.views.scene_extent``, world units.
        """
        poses, intrinsics = None, None
        if options.refine_poses:
            limit = options.experiments.max_pose_change
            poses = PoseRefinement.of(views, gaussians, extent, limit)
        if options.refine_intrinsics:
            intrinsics = IntrinsicsRefinement.of(views, options.experiments.max_intrinsics_change)
        return CameraRefinement(len(views), poses, intrinsics)

    @property
    def enabled(self) -> bool:
        return self.poses is not None or self.intrinsics is not None

    def camera(self, camera: RasterCamera, index: int) -> RasterCamera:
        """The refined camera of a view, from the given one."""
        if self.intrinsics is not None:
            camera = self.intrinsics.camera(camera, index)
        return camera if self.poses is None else self.poses.camera(camera, index)

    def step(
        self,
        index: int,
        camera: RasterCamera,
        gradients: CameraGradients,
        rate: Callable[[float], float],
    ) -> None:
        """Refine the camera of a view.

        Args:
            camera: The refined camera that the view was rendered with.
            rate: The learning rate of parameters that this share of the steps changes, relative to
                the upper limit of their total change (``Schedule.camera_rate``).
        """
        if self.poses is not None:
            self.poses.step(index, gradients, self.poses.limit * rate(1 / self.num_views))
        if self.intrinsics is not None:
            share = self.intrinsics.num_sharing(index) / self.num_views
            self.intrinsics.step(index, camera, gradients, self.intrinsics.limit * rate(share))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of a checkpoint."""
        poses = {} if self.poses is None else self.poses.arrays()
        return poses if self.intrinsics is None else poses | self.intrinsics.arrays()

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        for part in (self.poses, self.intrinsics):
            if part is not None:
                part.restore(arrays)
