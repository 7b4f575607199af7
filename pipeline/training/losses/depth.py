"""Depths that are known beforehand: of the sparse points, at the pixels where views see them.

Where few photographs see a surface, colours alone leave its distance open, and Gaussians that hang
in front of one camera explain its picture as well as the wall behind them would.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pipeline.render import Forward
from pipeline.scene.views import View
from pipeline.training.data.known_depths import KnownDepths

#: Where Huber's square ends, in the logarithm: beyond 1 % the pull is constant.
TOLERANCE = 0.01
#: Pixels more transparent than this have no depth yet.
MIN_ALPHA = 0.1


def depth_gradients(
    rendered: Forward, known: KnownDepths, view: View, weight: float
) -> tuple[Tensor, Tensor]:
    """Gradients of ``weight`` times the mean Huber loss of log(D / z), D being the rendered depth
    over alpha: in logarithms, so that near and far count alike.

    Args:
        rendered: of ``view`` at any of its sizes.

    Returns:
        d_alpha, d_depth: (H, W) float32, for ``render.backward``.
    """
    height, width = rendered.alpha.shape
    column = torch.from_numpy((known.xy[:, 0] * (width / view.width)).astype(np.int64))
    row = torch.from_numpy((known.xy[:, 1] * (height / view.height)).astype(np.int64))
    column, row = column.clamp_(max=width - 1), row.clamp_(max=height - 1)
    alpha, depth = rendered.alpha[row, column], rendered.depth[row, column]
    usable = ((alpha > MIN_ALPHA) & (depth > 0)).to(torch.float32)
    alpha, depth = alpha.clamp(min=MIN_ALPHA), depth.where(usable > 0, torch.ones(()))
    off = torch.log(depth / alpha / torch.from_numpy(known.z)) * usable
    share = torch.from_numpy(known.weight) * (weight / max(1, len(known)))
    # d log(depth / alpha): 1 / depth and -1 / alpha.
    pull = (off / TOLERANCE).clamp(-1, 1) * share
    d_alpha, d_depth = torch.zeros_like(rendered.alpha), torch.zeros_like(rendered.alpha)
    d_alpha.index_put_((row, column), -pull / alpha, accumulate=True)
    d_depth.index_put_((row, column), pull / depth, accumulate=True)
    return d_alpha, d_depth
