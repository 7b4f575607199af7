"""What a view shows around a block: the Gaussians of other blocks, as images.

Blocks are convex. The other Gaussians on a ray that meets a block are therefore either in front of
it or behind it, and the image of the whole scene is a composition of three layers (Porter and Duff
1984): the front, the block, and what is behind it. Where extended Gaussians overlap across a face,
layers are not exact: the error before training is known and corrected.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

# Larger changes of alpha are penalised. Otherwise a block would fade, since what is behind it often
# has its colour, and each of two blocks on a ray could leave a pixel to the other one.
ALPHA_LOSS_WEIGHT, FADE_TOLERANCE, GROWTH_TOLERANCE = 1.0, 0.02, 0.25


@dataclass(frozen=True)
class Surroundings:
    """The layers around a block in one view.

    Attributes:
        behind: (H, W, 3) uint8, the scene behind the block over the background.
        alpha: (H, W) uint8 of the block before training.
        front: (H, W, 3) uint8, the scene in front of the block, multiplied by its alpha; None if
            nothing is.
        transmittance: (H, W) uint8 of the front, 255 where there is none; None if nothing is.
        correction: (H, W, 3) int8, in 1/255: what the composition before training lacks of the
            image of the whole scene; None: nothing.
    """

    behind: Tensor
    alpha: Tensor
    front: Tensor | None = None
    transmittance: Tensor | None = None
    correction: Tensor | None = None

    def corrected(self, error: Tensor) -> Surroundings:
        """The layers with a correction of the composition by ``error`` (H, W, 3)."""
        return replace(self, correction=(error * 255).round().clamp(-127, 127).to(torch.int8))

    def compose(self, color: Tensor, alpha: Tensor) -> Tensor:
        """(H, W, 3) float32 image of the whole scene.

        Args:
            color: (H, W, 3) float32 of the block, without a background.
            alpha: (H, W) float32 of the block.
        """
        image = ((1 - alpha)[..., None] * self._behind).add_(color)
        if self.front is not None and self._passing is not None:
            image.mul_(self._passing).add_(self.front, alpha=1 / 255)
        return image if self.correction is None else image.add_(self.correction, alpha=1 / 255)

    def alpha_gradient(self, alpha: Tensor) -> Tensor:
        """(H, W) float32 gradient of ``ALPHA_LOSS_WEIGHT`` times the mean square of the part of
        the change of the block's ``alpha`` (H, W) that exceeds the tolerances."""
        change = alpha - _unit(self.alpha)
        beyond = change - change.clamp(-FADE_TOLERANCE, GROWTH_TOLERANCE)
        return beyond * (2 * ALPHA_LOSS_WEIGHT / beyond.numel())

    def gradients(self, d_image: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients with respect to ``color`` (H, W, 3) and ``alpha`` (H, W) of ``compose``, from
        the gradient with respect to its image (H, W, 3), float32."""
        d_color = d_image if self._passing is None else d_image * self._passing
        return d_color, -(d_color * self._behind).sum(-1)

    # Both are used twice in a training step.
    @cached_property
    def _behind(self) -> Tensor:
        return _unit(self.behind)

    @cached_property
    def _passing(self) -> Tensor | None:
        """(H, W, 1) transmittance of the front."""
        return None if self.transmittance is None else _unit(self.transmittance)[..., None]


def _unit(values: Tensor) -> Tensor:
    return values.to(torch.float32).mul_(1 / 255)
