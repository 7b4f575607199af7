"""The loss of an image, and the image of a part of a scene among its surroundings."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render.gpu import layout
from pipeline.render.gpu.counts import BindGroup
from pipeline.render.gpu.device import Buffer, Gpu, blocks
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.types import AlphaChangeLoss, Surroundings

Gain = tuple[float, float, float]
NO_GAIN: Gain = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class LossImage:
    """A photograph on the device.

    Attributes:
        target, mask: As of ``Backend.l1_ssim``; bytes are padded to words.
        count: The number of unmasked values.
        is_bytes: Whether the target is uint8.
    """

    target: Buffer
    mask: Buffer | None
    count: int
    is_bytes: bool
    _groups: dict[tuple[int, ...], BindGroup] = field(default_factory=dict)

    @staticmethod
    def upload(gpu: Gpu, target: Tensor, mask: Tensor | None) -> LossImage:
        ignored = 0 if mask is None else int((mask != 0).sum())
        return LossImage(
            gpu.upload(target.contiguous().numpy(), what="a training image"),
            None if mask is None else gpu.upload(mask.contiguous().numpy()),
            target.numel() - 3 * ignored,
            target.dtype == torch.uint8,
        )

    @property
    def buffers(self) -> dict[str, Buffer]:
        """The buffers by the names of loss.wgsl."""
        masked = {} if self.mask is None else {"mask": self.mask}
        return {"target_words": self.target, **masked}

    def run(self, gpu: Gpu, groups: tuple[int, int, int], **buffers: Buffer) -> None:
        """Run the kernel ``loss`` as ``Workspace.run`` does. The bind group is kept with the image:
        one of a workspace would keep all images in memory."""
        key = tuple(map(id, buffers.values()))
        if key not in self._groups:
            self._groups.clear()
            self._groups[key] = gpu.bind("loss", buffers)
        gpu.dispatch("loss", groups, self._groups[key])


@dataclass(frozen=True)
class LossSums:
    """The loss on the device: ``rows`` sums of parts of the image, and the gradient with respect to
    the rendered image (H, W, 3)."""

    gradient: Buffer
    sums: Buffer
    rows: int
    count: int

    def means(self, total: NDArray[np.float64]) -> tuple[float, float, float]:
        """The means of the error, of SSIM and of the squared difference, from the sum of the rows;
        (0, 1, 0) of no pixels."""
        if not self.count:
            return 0.0, 1.0, 0.0
        error, ssim, squared, _ = total / self.count
        return float(error), float(ssim), float(squared)


def l1_ssim(
    space: Workspace,
    rendered: Buffer,
    image: LossImage,
    size: tuple[int, int],
    ssim_weight: float,
    l2_weight: float,
    gain: Gain = NO_GAIN,
) -> LossSums:
    """The loss of ``Backend.l1_ssim``, of the rendered image times ``gain``."""
    tiles = layout.tiles_of(*size)
    rows, count = 3 * tiles[0] * tiles[1], max(1, image.count)
    flags = layout.BYTES * image.is_bytes + layout.MASKED * (image.mask is not None)
    scales = (1 - ssim_weight) / count, -ssim_weight / count
    arguments = {
        "loss": space.gpu.uniform("4I8f", *size, flags, 0, l2_weight, *scales, 0.0, *gain, 0.0),
        "rendered": rendered,
        "gradient": space.get("gradient of the image", 12 * size[0] * size[1]),
        "sums": space.get("sums of the loss", 16 * rows),
        **image.buffers,
    }
    image.run(space.gpu, (*tiles, 3), **arguments)
    return LossSums(arguments["gradient"], arguments["sums"], rows, image.count)


def upload_layers(gpu: Gpu, around: Surroundings) -> dict[str, Buffer]:
    """The images of the surroundings, by the names of compose.wgsl."""
    layers = {
        "behind": around.behind,
        "alpha_before": around.alpha,
        "front": around.front,
        "transmittance": around.transmittance,
        "correction": around.correction,
    }
    return {k: gpu.upload(v.numpy()) for k, v in layers.items() if v is not None}


def compose(
    space: Workspace,
    kernel: str,
    layers: dict[str, Buffer],
    pixels: int,
    loss: AlphaChangeLoss,
    **images: Buffer,
) -> None:
    """Run ``compose.compose`` or ``compose.backward``, by the names of compose.wgsl.

    Args:
        layers: See ``upload_layers``.
        images: ``alpha`` of the part, ``values`` and ``result``; ``d_alpha`` of the gradient.
    """
    flags = layout.FRONT * ("front" in layers) | layout.CORRECTION * ("correction" in layers)
    factor = 2 * loss.weight / pixels
    sizes = space.gpu.uniform("II4f8x", pixels, flags, loss.fade, loss.growth, factor, 0.0)
    # The bind group is not kept: it would keep the layers in memory.
    space.gpu.run(kernel, blocks(pixels), layers=sizes, **layers, **images)
