"""The layers around a block, rendered from the coarse Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from threading import Lock

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render import Backend, Color, Forward, RasterOptions
from pipeline.render.views import raster_camera
from pipeline.scene.blocks import BlockView, Box
from pipeline.scene.exposure import NO_GAINS, ExposureGains
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.training.data.surroundings import Surroundings
from pipeline.training.data.targets import Layers

# A block is trained in the pixels of which it explains more than this share. In the others it keeps
# the scene as it is: two blocks that corrected the same pixel would correct it twice.
USED_SHARE = 0.5
# Fronts of less alpha everywhere are left out.
MIN_FRONT = 2 / 255


@dataclass(frozen=True)
class BlockLayers:
    """Renders the layers around a block in any view (``training.data.targets.LayerSource``), one
    view at a time: each render needs as much memory as all Gaussians.

    Attributes:
        coarse: the Gaussians of the whole scene before the blocks are trained.
        region: of the block, with its margin.
        background: behind the scene.
        options: as in training, without a background.
        gains: of the views, by which renders are multiplied before they are compared.
        windows: of the views that the block is seen in, by name. Whole views ignore them: the block
            is trained on the windows themselves.
    """

    coarse: Gaussians
    region: Box
    background: Color
    options: RasterOptions
    backend: Backend
    gains: ExposureGains = NO_GAINS
    windows: Mapping[str, BlockView] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock, compare=False)

    def __call__(self, view: View) -> Layers:
        with self._lock:
            return self._layers(view)

    def _layers(self, view: View) -> Layers:
        # Several times faster than to render all Gaussians in each layer.
        visible = self._visible(view)
        means = visible.means.numpy()
        own = self.region.contains(means)
        behind = self.region.hides(view.centre, means) & ~own
        front = self._render(visible, ~own & ~behind, view)
        block = self._render(visible, own, view)
        back = self._render(visible, behind, view, self.background)
        around = Surroundings(_bytes(back.color), _bytes(block.alpha))
        if float(front.alpha.max()) >= MIN_FRONT:
            transmittance = _bytes(1 - front.alpha)
            around = replace(around, front=_bytes(front.color), transmittance=transmittance)
        whole = self._render(visible, np.ones(len(visible), np.bool_), view, self.background)
        scene = whole.color
        around = around.corrected(scene - around.compose(block.color, block.alpha))
        if (gain := self.gains.of(view.name)) is not None:
            scene = scene * torch.tensor(gain, dtype=torch.float32)
        return Layers(
            surroundings=around,
            used=(1 - front.alpha) * block.alpha > USED_SHARE,
            coarse=_bytes(scene),
            background=self.background,
            ignored=self._ignored(view),
        )

    def _ignored(self, view: View) -> Tensor | None:
        shown = self.windows.get(view.name)
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
        which: NDArray[np.bool_],
        view: View,
        background: Color | None = None,
    ) -> Forward:
        chosen = gaussians.select(torch.from_numpy(np.flatnonzero(which)))
        options = replace(self.options, background=background)
        return self.backend.forward(*chosen.parameters(), raster_camera(view), options)


def _bytes(values: Tensor) -> Tensor:
    return (values.clamp(0, 1) * 255).round().to(torch.uint8)
