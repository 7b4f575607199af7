"""The layers around a block, rendered from the coarse Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from threading import Lock

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render import Backend, Color, RasterOptions
from pipeline.render.contributions import in_grey
from pipeline.render.views import raster_camera
from pipeline.scene.blocks import Partition
from pipeline.scene.exposure import NO_GAINS, ExposureGains
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.training.blocks.shares import IMAGE_FACTOR, SHOWN_SHARE, explained_shares
from pipeline.training.data.surroundings import Surroundings
from pipeline.training.data.targets import Layers, usable_factor

# Fronts of less alpha everywhere are left out.
MIN_FRONT = 2 / 255


@dataclass(frozen=True)
class BlockLayers:
    """Renders the layers around a block in any view (``training.data.targets.LayerSource``), one
    view at a time: each render needs as much memory as all Gaussians.

    Attributes:
        coarse: the Gaussians of the whole scene before the blocks are trained.
        partition, number: the block.
        background: behind the scene.
        options: as in training, without a background.
        gains: of the views, by which renders are multiplied before they are compared.
    """

    coarse: Gaussians
    partition: Partition
    number: int
    background: Color
    options: RasterOptions
    backend: Backend
    gains: ExposureGains = NO_GAINS
    _lock: Lock = field(default_factory=Lock, compare=False)

    def __call__(self, view: View) -> Layers:
        with self._lock:
            return self._layers(view)

    def _layers(self, view: View) -> Layers:
        # Several times faster than to render all Gaussians in each layer.
        visible = self._visible(view)
        means, region = visible.means.numpy(), self.partition.region(self.number)
        own = region.contains(means)
        behind = region.hides(view.centre, means) & ~own
        front, front_alpha = self._render(visible, ~own & ~behind, view)
        block, block_alpha = self._render(visible, own, view)
        back, _ = self._render(visible, behind, view, self.background)
        around = Surroundings(_bytes(back), _bytes(block_alpha))
        if float(front_alpha.max()) >= MIN_FRONT:
            transmittance = _bytes(1 - front_alpha)
            around = replace(around, front=_bytes(front), transmittance=transmittance)
        scene, _ = self._render(visible, None, view, self.background)
        around = around.corrected(scene - around.compose(block, block_alpha))
        if (gain := self.gains.of(view.name)) is not None:
            scene = scene * torch.tensor(gain, dtype=torch.float32)
        return Layers(
            surroundings=around,
            weight=self._weight(visible, view),
            coarse=_bytes(scene),
            background=self.background,
            ignored=self._ignored(view),
        )

    def _weight(self, gaussians: Gaussians, view: View) -> Tensor:
        """(H, W) float32, what the block explains of each pixel, of all that blocks explain. Two
        blocks that corrected the same error of a pixel would correct it twice."""
        factor = usable_factor([view], IMAGE_FACTOR)
        means = gaussians.means.numpy()
        box, others = self.partition.scene_boxes(self.number)
        boxes = [box.contains(means)]
        boxes += [inside for each in others if (inside := each.contains(means)).any()]
        options = replace(self.options, sh_degree=0)
        shares, _ = explained_shares(
            in_grey(gaussians), boxes, raster_camera(view, factor), options, self.backend
        )
        own, total = shares[0], np.sum(shares, axis=0)
        weight = np.where(own > SHOWN_SHARE, own / np.maximum(total, SHOWN_SHARE), 0)
        size = view.width, view.height
        return torch.from_numpy(cv2.resize(weight, size, interpolation=cv2.INTER_LINEAR))

    def _ignored(self, view: View) -> Tensor | None:
        """The window of a whole view: the block is trained on the window itself."""
        shown = self.partition.blocks[self.number - 1].window_of(view.name)
        if shown is None or view.crop is not None:
            return None
        ignored = torch.zeros(view.height, view.width, dtype=torch.bool)
        left, top, right, bottom = shown.window_in(view.width, view.height)
        ignored[top:bottom, left:right] = True
        return ignored

    def _visible(self, view: View) -> Gaussians:
        """The Gaussians that the view shows."""
        which = self.backend.visible(self.coarse.parameters(), raster_camera(view), self.options)
        return self.coarse.select(which.nonzero()[:, 0])

    def _render(
        self,
        gaussians: Gaussians,
        which: NDArray[np.bool_] | None,
        view: View,
        background: Color | None = None,
    ) -> tuple[Tensor, Tensor]:
        """(H, W, 3) colour and (H, W) alpha of some of the Gaussians, or of all."""
        if which is not None:
            gaussians = gaussians.select(torch.from_numpy(np.flatnonzero(which)))
        options = replace(self.options, background=background)
        found = self.backend.forward(*gaussians.parameters(), raster_camera(view), options)
        return found.color, found.alpha


def _bytes(values: Tensor) -> Tensor:
    return (values.clamp(0, 1) * 255).round().to(torch.uint8)
