"""What training starts from."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.training.data.known_depths import KnownDepths


@dataclass(frozen=True)
class Inputs:
    """A scene before training.

    Attributes:
        views: training views only.
        initial: the first Gaussians.
        extent: how far apart the cameras stand, world unit (``scene.views.scene_extent``): the near
            plane and the cameras' own steps are measured by it.
        scale: by which the means' steps and the sizes of Gaussians are measured
            (``training.data.known_depths.scene_scale``); None: the extent.
        gains: (V, 3), by which a view's photograph is brighter than the scene's typical one
            (``photos.exposure``): renders are multiplied before they are compared. Only for
            views without alpha.
        depths: what is known beforehand of each view's depths (``training.losses.depth``), to which
            renders are held with ``Train.depth_weight``.
        air: (V,) camera z, world unit, up to which each view sees nothing
            (``training.density.floaters.air_depths``); 0 where that is not known.
    """

    views: Sequence[View]
    initial: Gaussians
    extent: float
    scale: float | None = None
    gains: NDArray[np.float64] | None = None
    depths: Sequence[KnownDepths] | None = None
    air: NDArray[np.float64] | None = None

    @property
    def size(self) -> float:
        """The scale, or the extent where there is none."""
        return self.extent if self.scale is None else self.scale

    def without(self, views: Collection[int]) -> Inputs:
        """Without the views of these indices."""
        kept = [index for index in range(len(self.views)) if index not in views]
        return replace(
            self,
            views=[self.views[index] for index in kept],
            gains=None if self.gains is None else self.gains[kept],
            depths=None if self.depths is None else [self.depths[index] for index in kept],
            air=None if self.air is None else self.air[kept],
        )
