"""The depth loss, at pixels with known depths.

If few photographs see a surface, colours alone do not determine its distance, and Gaussians close
to one camera explain its photograph as well as the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipeline.render.resident import Planes
from pipeline.scene.views import View
from pipeline.training.data.known_depths import KnownDepths
from pipeline.training.data.step_view import StepView
from pipeline.training.losses.plane import PlaneGradients

#: The loss is computed in some of the steps only, with a weight as if in all: rendering depths and
#: their gradients takes half the time of a step.
INTERVAL = 4

#: Error of the logarithm at which the Huber loss becomes linear: 1 %.
TOLERANCE = 0.01
#: Pixels with less alpha have no depth.
MIN_ALPHA = 0.1


@dataclass(frozen=True)
class DepthLoss:
    """The depth loss of a run.

    Attributes:
        known: The known depths of each training view.
    """

    known: Sequence[KnownDepths]
    weight: float

    def is_due(self, view: StepView, step: int) -> bool:
        return bool(self.known[view.index]) and step % INTERVAL == 0

    def gradients(self, rendered: Planes, view: StepView) -> PlaneGradients:
        known = self.known[view.index]
        return PlaneGradients(*depth_gradients(rendered, known, view.full, self.weight * INTERVAL))


def depth_gradients(
    rendered: Planes, known: KnownDepths, view: View, weight: float
) -> tuple[Tensor, Tensor]:
    """Gradients of ``weight`` times the mean Huber loss of log(D / z), D being the rendered depth
    over alpha. In logarithms, relative errors count the same at all depths.

    Args:
        rendered: The render of ``view`` at full or reduced size.

    Returns:
        The gradients d_alpha and d_depth, (H, W) float32, for ``render.backward``.
    """
    image_alpha = rendered.alpha
    height, width = image_alpha.shape
    column = torch.from_numpy((known.xy[:, 0] * (width / view.width)).astype(np.int64))
    row = torch.from_numpy((known.xy[:, 1] * (height / view.height)).astype(np.int64))
    column, row = column.clamp_(max=width - 1), row.clamp_(max=height - 1)
    alpha, depth = image_alpha[row, column], rendered.depth[row, column]
    usable = ((alpha > MIN_ALPHA) & (depth > 0)).to(torch.float32)
    alpha, depth = alpha.clamp(min=MIN_ALPHA), depth.where(usable > 0, torch.ones(()))
    off = torch.log(depth / alpha / torch.from_numpy(known.z)) * usable
    share = torch.from_numpy(known.weight) * (weight / max(1, len(known)))
    # d log(depth / alpha): 1 / depth and -1 / alpha.
    gradient = (off / TOLERANCE).clamp(-1, 1) * share
    d_alpha, d_depth = torch.zeros_like(image_alpha), torch.zeros_like(image_alpha)
    d_alpha.index_put_((row, column), -gradient / alpha, accumulate=True)
    d_depth.index_put_((row, column), gradient / depth, accumulate=True)
    return d_alpha, d_depth
