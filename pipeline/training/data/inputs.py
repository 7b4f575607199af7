"""The inputs of training."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.scene.exposure import ViewLight
from pipeline.scene.views import View, reduced_size
from pipeline.splats.gaussians import Gaussians
from pipeline.training.data.known_depths import KnownDepths
from pipeline.training.data.targets import LayerSource


@dataclass(frozen=True)
class Inputs:
    """A scene before training.

    Attributes:
        views: The training views.
        initial: The initial Gaussians.
        extent: ``scene.views.scene_extent``, world units: determines the near plane and is the unit
            of camera refinement.
        scale: The unit of the means' learning rate and of the sizes of Gaussians, world units
            (``training.data.known_depths.scene_scale``); None: the extent.
        light: The light of each photograph relative to the scene's typical one
            (``photos.exposure``, ``photos.shading``), by which renders are multiplied
            before the loss; None: all 1. Only for views without alpha.
        embeddings: (V, K) appearance embeddings of the photographs before training
            (``training.appearance``); None: appearance is not modelled. Only for a whole scene.
        depths: The known depths of each view for the depth loss (``training.losses.depth``).
        empty_depths: (V,) camera z, world units, up to which each view sees empty space
            (``training.density.floaters.empty_depths``); 0 if unknown.
        seen_share: The mean share of the views that see a Gaussian (``scene.visibility``).
        open_layers: For a block of a scene, it makes the source of the layers around it in each
            view, which renders with so many threads and is not held during training; None: the
            Gaussians are the whole scene.
    """

    views: Sequence[View]
    initial: Gaussians
    extent: float
    scale: float | None = None
    light: Sequence[ViewLight] | None = None
    embeddings: NDArray[np.float64] | None = None
    depths: Sequence[KnownDepths] | None = None
    empty_depths: NDArray[np.float64] | None = None
    seen_share: float = 1.0
    open_layers: Callable[[int], LayerSource] | None = None

    @property
    def size(self) -> float:
        """The scale, or the extent if there is none."""
        return self.extent if self.scale is None else self.scale

    @property
    def gains(self) -> NDArray[np.float64] | None:
        """(V, 3) factors of the renders at the principal point; None if all are 1."""
        return None if self.light is None else np.array([light.gain for light in self.light])

    def light_factor(self, index: int, factor: int) -> Tensor | None:
        """The factor of the render of view ``index`` at 1 / ``factor`` of its size: (3,), or
        (H, W, 3) where it varies over the image; None for 1."""
        if self.light is None:
            return None
        view = self.views[index]
        return torch.from_numpy(self.light[index].factor(view, reduced_size(view, factor)))

    def without(self, views: Collection[int]) -> Inputs:
        """The same without the views with these indices."""
        kept = [index for index in range(len(self.views)) if index not in views]
        return replace(
            self,
            views=[self.views[index] for index in kept],
            light=None if self.light is None else [self.light[index] for index in kept],
            embeddings=None if self.embeddings is None else self.embeddings[kept],
            depths=None if self.depths is None else [self.depths[index] for index in kept],
            empty_depths=None if self.empty_depths is None else self.empty_depths[kept],
        )

    def sampled(self, views: int, rng: np.random.Generator) -> Inputs:
        """The same with at most so many of the views, chosen at random."""
        unused = rng.permutation(len(self.views))[views:]
        return self.without(set(unused.tolist())) if len(unused) else self
