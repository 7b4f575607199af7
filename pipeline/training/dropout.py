"""Random drop-out of Gaussians against overfitting to few photographs.

In each step, a random share of the Gaussians is not drawn, so that those behind them are trained as
well, and no Gaussian is needed by a single view alone. The opacities of the others are raised, so
that the expected sum of the opacities stays. The share rises linearly from 0. (Park et al. 2025,
"DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting".)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipeline.training.run import TrainingRun

# Up to so many training views, SHARE of the Gaussians is dropped at the end of the run.
FEW_VIEWS, SHARE = 12, 0.2
# The logit of a Gaussian that is not drawn.
DROPPED_LOGIT = -20.0
# Upper bound of raised opacities, as of all in training.
MAX_OPACITY = 0.999


@dataclass(frozen=True)
class ThinnedOpacities:
    """Opacities in one step.

    Attributes:
        logits: (N,) logits.
        derivative: (N,) their derivative with respect to the logits of the Gaussians, at most
            1 / (1 - share), so that opaque Gaussians keep a gradient.
    """

    logits: Tensor
    derivative: Tensor


def dropout_of(run: TrainingRun, views: int) -> float:
    """The share of the Gaussians that is dropped at the end of a run on so many ``views``."""
    share = run.options.experiments.dropout
    if share is None:
        share = SHARE if views <= FEW_VIEWS and not run.is_part else 0.0
    return share


def thinned(logits: Tensor, share: float, rng: np.random.Generator) -> ThinnedOpacities:
    """Drop a random ``share`` of the Gaussians with these opacity ``logits`` (N,), and divide the
    opacities of the others by 1 - ``share``."""
    dropped = torch.from_numpy(rng.random(len(logits), np.float32) < share)
    opacity = torch.sigmoid(logits)
    raised = (opacity / (1 - share)).clamp(max=MAX_OPACITY)
    return ThinnedOpacities(
        torch.where(dropped, DROPPED_LOGIT, torch.logit(raised)),
        torch.where(dropped, 0.0, (1 - opacity) / (1 - raised)).clamp(max=1 / (1 - share)),
    )
