"""What training does against overfitting to few photographs.

Drop-out: in each step, a random share of the Gaussians is not drawn, so that those behind them are
trained as well, and no Gaussian is needed by a single view alone. The opacities of the others are
raised, so that the expected sum of the opacities stays. The share rises linearly from 0. (Park et
al. 2025, "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting".) It adds an
error of about 1e-4 to squared colours, so it begins only if the error is much larger: one view is
held back in the first part of the run, and its render is compared with its photograph.

Spherical harmonics have no more coefficients than there are views: a Gaussian's colours in so many
views do not determine more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipeline.config.settled import TrainOptions
from pipeline.scene.views import View
from pipeline.training.density.timeline import schedule_length

# Up to so many training views, SHARE of the Gaussians is dropped at the end of the run.
FEW_VIEWS, SHARE = 26, 0.2
# Runs of fewer epochs do not overfit.
MIN_EPOCHS = 50
# With fewer views none is held back, since so few do not determine a scene.
MIN_VIEWS_TO_HOLD_BACK = 6
# A view is held back in this share of the run.
HELD_BACK_SHARE = 0.25
# Nothing is dropped if then the view that is held back, and the others, have this PSNR in dB, a
# mean squared error of 4e-4.
EXACT = 34.0
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


@dataclass(frozen=True)
class EarlyFit:
    """How well a run fits its views when one was held back.

    Attributes:
        held_back: PSNR of that view, dB.
        others: PSNR of the mean squared error of the other training views, dB.
    """

    held_back: float
    others: float

    @property
    def is_exact(self) -> bool:
        return min(self.held_back, self.others) >= EXACT


def dropout_of(options: TrainOptions, views: int) -> float:
    """The share of the Gaussians that is dropped at the end of a run on so many ``views``, unless
    its early fit is exact. While cameras are refined, it is 0 unless it is configured: their
    gradients are less exact with it."""
    share = options.experiments.dropout
    if share is None:
        refined = options.refine_poses or options.refine_intrinsics
        overfits = views <= FEW_VIEWS and schedule_length(options) >= MIN_EPOCHS * views
        share = SHARE if overfits and not refined else 0.0
    return share


def held_back_steps(options: TrainOptions, views: int) -> int:
    """The number of steps in which one of so many ``views`` is held back; 0: none is, and drop-out
    does not depend on an early fit."""
    given = options.experiments.dropout is not None
    if given or views < MIN_VIEWS_TO_HOLD_BACK or not dropout_of(options, views):
        return 0
    return round(HELD_BACK_SHARE * schedule_length(options))


def central_view(views: Sequence[View]) -> int:
    """The index of the view that has others around it: the medoid of centres, in units of their
    spread, and viewing directions."""
    centres = np.stack([view.centre for view in views])
    ahead = np.stack([view.world_to_camera[2, :3] for view in views])
    spread = np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()
    placed = np.concatenate([centres / max(float(spread), 1e-12), ahead], axis=1)
    apart = np.linalg.norm(placed[:, None] - placed[None], axis=2)
    return int(apart.sum(axis=1).argmin())


def sh_degree_of(options: TrainOptions, views: int) -> int:
    """The maximum degree of the spherical harmonics in a run on so many ``views``."""
    each = options.experiments.views_per_sh_coefficient
    degree = options.sh_degree
    while degree and each * (degree + 1) ** 2 > views:
        degree -= 1
    return degree


def few_views_lines(options: TrainOptions, views: int, fit: EarlyFit | None = None) -> list[str]:
    """What ``stage.json`` says about a run on few ``views``; empty for others."""
    lines = []
    if share := dropout_of(options, views):
        reason = f"{views} training views"
        if fit is not None:
            reason += f", one held back at first: {fit.held_back:.1f} dB, others {fit.others:.1f}"
        if fit is None or not fit.is_exact:
            what = f"up to {share:.0%} of the Gaussians, chosen at random, are not drawn"
            lines.append(f"{reason}: in each step, {what}")
        else:
            lines.append(f"{reason}: all Gaussians are drawn in each step")
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
