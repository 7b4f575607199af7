"""Floaters: Gaussians close to one camera, or to very few, that no other view contradicts.

They explain the photographs of these cameras as well as the surface behind them, and other cameras
look past them or see them as dots. With changing light, a few neighbouring views can agree on them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render.contributions import contributions, in_grey
from pipeline.splats.gaussians import Gaussians
from pipeline.training.data.known_depths import KnownDepths
from pipeline.training.density.camera_path import on_camera_path
from pipeline.training.density.reduced_views import ReducedViews

#: Space closer than this share of the depth of a view's nearest sparse points is taken as empty.
#: Nearest is this quantile, since a few points are wrong, of at least so many points.
EMPTY_SHARE, NEAREST, MIN_POINTS = 0.5, 0.02, 20
#: A floater has more than this share of its weight, and more than this number of pixels, in the
#: empty space of the views that have most of it: one in so many views, at least one.
WEIGHT_SHARE, MIN_WEIGHT = 0.5, 0.1
VIEWS_PER_FLOATER_VIEW = 100
FADED_LOGIT = -20.0  # The opacity logit of a faded floater.
#: Floaters are removed after these shares of a run, so that others can take their place.
RUN_SHARES = 0.3, 0.5, 0.7, 0.9
#: Runs of fewer epochs have hardly any floaters, and one removal costs as much as two epochs.
MIN_EPOCHS = 50
#: Images are rendered at 1 / this of their size.
IMAGE_FACTOR = 4


def empty_depths(known: Sequence[KnownDepths]) -> NDArray[np.float64]:
    """(V,) camera z, world unit, up to which each view sees empty space; 0 with too few points."""
    return np.array(
        [EMPTY_SHARE * np.quantile(k.z, NEAREST) if len(k) >= MIN_POINTS else 0.0 for k in known]
    )


@dataclass(frozen=True)
class FloaterRemoval:
    """Removes floaters a few times in a run, and at its end.

    Attributes:
        depths: (V,) camera z (``empty_depths``).
        steps: The length of the schedule.
    """

    depths: NDArray[np.float64]
    steps: int

    def is_due(self, steps: range, run_length: float) -> bool:
        """Whether floaters are removed after these steps of the schedule.

        Args:
            run_length: The expected number of optimiser steps of the run.
        """
        if run_length < MIN_EPOCHS * len(self.depths):
            return False
        return any(round(share * self.steps) in steps for share in RUN_SHARES)

    def fade(self, gaussians: Gaussians, views: ReducedViews) -> int:
        """Make floaters transparent, in place, so that density control prunes them.

        Returns:
            The number of floaters.
        """
        found = floaters(gaussians, views, self.depths)
        gaussians.opacity_logits[found] = FADED_LOGIT
        return int(found.sum())

    def without_blockers(self, gaussians: Gaussians, views: ReducedViews) -> Gaussians:
        """The Gaussians without those that hide views from between the cameras, unless all do."""
        found = on_camera_path(gaussians, views, self.depths)
        return gaussians if found.all() else gaussians.select(torch.nonzero(~found)[:, 0])


def floaters(gaussians: Gaussians, views: ReducedViews, depths: NDArray[np.float64]) -> Tensor:
    """(N,) bool: Gaussians with most of their weight in one view, or in a hundredth of the views,
    and there closer than ``depths``.

    The weight of a Gaussian in a view is its ``render.contributions``.

    Args:
        views: All training views.
        depths: (V,) camera z (``empty_depths``).
    """
    grey = in_grey(gaussians)
    total = torch.zeros(len(grey))
    # The largest weights so far, and the part of each that is in empty space.
    few = max(1, round(len(views.cameras) / VIEWS_PER_FLOATER_VIEW))
    largest, largest_empty = torch.zeros(few, len(grey)), torch.zeros(few, len(grey))
    for camera, depth in zip(views.cameras, depths, strict=True):
        weight = contributions(grey, camera, views.options, views.pixel, views.backend)
        total += weight
        x, y, z, shift = camera.world_to_camera[2].to(torch.float32).tolist()
        # A matrix product of BLAS may round differently with the number of threads.
        z_camera = grey.means[:, 0] * x + grey.means[:, 1] * y + grey.means[:, 2] * z + shift
        empty = torch.where(z_camera < depth, weight, 0.0)
        # Insertion sort: smaller weights move down a row, the smallest is dropped.
        for row in range(few):
            larger = weight > largest[row]
            weight, largest[row] = (
                torch.where(larger, largest[row], weight),
                torch.where(larger, weight, largest[row]),
            )
            empty, largest_empty[row] = (
                torch.where(larger, largest_empty[row], empty),
                torch.where(larger, empty, largest_empty[row]),
            )
    found = largest_empty.sum(0)
    return (found > MIN_WEIGHT) & (found > WEIGHT_SHARE * total)
