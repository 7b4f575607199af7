"""The layers around a block, rendered from the coarse Gaussians."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import Lock

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render import Backend, Color, RasterOptions, Subset, Surroundings
from pipeline.render.contributions import in_grey
from pipeline.render.views import raster_camera
from pipeline.scene.blocks import Box, Partition
from pipeline.scene.exposure import NO_GAINS, ExposureGains
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.training.blocks.shares import IMAGE_FACTOR, SHOWN_SHARE, explained_shares
from pipeline.training.data.targets import Layers, usable_factor

# Fronts of less alpha everywhere are left out.
MIN_FRONT = 2 / 255


@dataclass(frozen=True)
class BlockLayers:
    """Renders the layers around a block in any view (``training.data.targets.LayerSource``), one
    view at a time: each render needs as much memory as all Gaussians.

    Attributes:
        coarse: The Gaussians of the whole scene before the blocks are trained.
        partition, number: The block.
        corrects: The box whose Gaussians explain the part of an error that the block corrects.
        background: The background behind the scene.
        options: The options of training, without a background.
        gains: The exposure gains of the views, by which renders are multiplied before they are
            compared.
    """

    coarse: Gaussians
    partition: Partition
    number: int
    corrects: Box
    background: Color
    options: RasterOptions
    backend: Backend
    gains: ExposureGains = NO_GAINS
    _lock: Lock = field(default_factory=Lock, compare=False)

    def __call__(self, view: View) -> Layers:
        with self._lock:
            layers = self._layers(view)
            self.backend.release_memory()
            return layers

    def _layers(self, view: View) -> Layers:
        def layers(visible: Tensor) -> Iterator[Subset]:
            around = visible & ~self._own
            behind = around & self._hidden(around, view)
            yield Subset(around & ~behind)
            yield Subset(visible & self._own)
            yield Subset(behind, self.background)
            yield Subset(visible, self.background)

        rendered = self.backend.forward_subsets(
            self.coarse.parameters(), raster_camera(view), self.options, layers
        )
        # Only the image of each render is kept.
        images = ((found.color, found.alpha) for found in rendered)
        front, transmittance = _front(*next(images))
        block, block_alpha = next(images)
        behind = _bytes(next(images)[0])
        around = Surroundings(behind, _bytes(block_alpha), front, transmittance)
        scene = next(images)[0]
        error = scene - self.backend.compose(around, block, block_alpha, self.options.threads)
        correction = (error * 255).round().clamp(-127, 127).to(torch.int8)
        if (light := self.gains.of(view.name)) is not None:
            scene = scene * torch.from_numpy(light.factor(view))
        return Layers(
            surroundings=replace(around, correction=correction),
            weight=self._weight(view),
            coarse=_bytes(scene),
            background=self.background,
            ignored=self._ignored(view),
        )

    def _hidden(self, which: Tensor, view: View) -> Tensor:
        """(N,) bool: the Gaussians of ``which``, outside of the region, that are behind it."""
        rows = which.nonzero()[:, 0]
        means = self.coarse.means[rows].numpy()
        hidden = torch.zeros_like(which)
        hidden[rows] = torch.from_numpy(self._region.hides(view.centre, means))
        return hidden

    def _weight(self, view: View) -> Tensor:
        """(H, W) float32, what ``corrects`` explains of each pixel, of all that blocks explain: two
        blocks that corrected the same error of a pixel would correct it twice."""
        factor = usable_factor([view], IMAGE_FACTOR)
        options = replace(self.options, sh_degree=0)
        (own, blocks), _ = explained_shares(
            self._grey, self._explaining, raster_camera(view, factor), options, self.backend
        )
        weight = np.where(own > SHOWN_SHARE, own / np.maximum(blocks, SHOWN_SHARE), 0)
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

    @cached_property
    def _region(self) -> Box:
        return self.partition.region(self.number)

    @cached_property
    def _own(self) -> Tensor:
        """(N,) bool, the Gaussians of the region."""
        return torch.from_numpy(self._region.contains(self.coarse.means.numpy()))

    @cached_property
    def _explaining(self) -> list[NDArray[np.bool_]]:
        """The Gaussians of ``corrects``, and of all blocks."""
        means = self.coarse.means.numpy()
        return [box.contains(means) for box in (self.corrects, self.partition.bounds)]

    @cached_property
    def _grey(self) -> Gaussians:
        return in_grey(self.coarse)


def _front(color: Tensor, alpha: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """The front's colour and transmittance as in ``Surroundings``."""
    return (_bytes(color), _bytes(1 - alpha)) if float(alpha.max()) >= MIN_FRONT else (None, None)


def _bytes(values: Tensor) -> Tensor:
    return (values.clamp(0, 1) * 255).round().to(torch.uint8)
