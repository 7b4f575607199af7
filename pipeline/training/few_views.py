"""What training does against overfitting to few photographs.

Drop-out: in each step, a random share of the Gaussians is not drawn, so that those behind them are
trained as well, and no Gaussian is needed by a single view alone. The opacities of the others are
raised, so that the expected sum of the opacities stays. The share rises linearly from 0. (Park et
al. 2025, "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting".)

Spherical harmonics have no more coefficients than there are views: a Gaussian's colours in so many
views do not determine more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipeline.config.settled import TrainOptions
from pipeline.training.density.timeline import schedule_length

# Up to so many training views, SHARE of the Gaussians is dropped at the end of the run.
FEW_VIEWS, SHARE = 26, 0.2
# Runs of fewer epochs do not overfit.
MIN_EPOCHS = 50
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


def dropout_of(options: TrainOptions, views: int) -> float:
    """The share of the Gaussians that is dropped at the end of a run on so many ``views``. While
    cameras are refined, it is 0 unless it is configured: their gradients are less exact with it."""
    share = options.experiments.dropout
    if share is None:
        refined = options.refine_poses or options.refine_intrinsics
        overfits = views <= FEW_VIEWS and schedule_length(options) >= MIN_EPOCHS * views
        share = SHARE if overfits and not refined else 0.0
    return share


def sh_degree_of(options: TrainOptions, views: int) -> int:
    """The maximum degree of the spherical harmonics in a run on so many ``views``."""
    each = options.experiments.views_per_sh_coefficient
    degree = options.sh_degree
    while degree and each * (degree + 1) ** 2 > views:
        degree -= 1
    return degree


def few_views_lines(options: TrainOptions, views: int) -> list[str]:
    """What ``stage.json`` says about a run on few ``views``; empty for others."""
    lines = []
    if share := dropout_of(options, views):
        what = f"up to {share:.0%} of the Gaussians, chosen at random, are not drawn"
        lines.append(f"{views} training views: in each step, {what}")
    if (degree := sh_degree_of(options, views)) < options.sh_degree:
        lines.append(f"{views} training views: the degree of spherical harmonics is {degree}")
    return lines


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
