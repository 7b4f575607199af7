"""Finds the Gaussians that hide the scene from places beside the cameras.

No photograph contradicts a Gaussian that stands beside or behind the cameras, or that one of them
alone shows. From a place where one may walk, it can hide everything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pipeline.coverage.contradictions import empty_depth
from pipeline.coverage.defects import MIN_AGREEING
from pipeline.coverage.novel_views import free_novel_views
from pipeline.coverage.probe_views import Doubles, reduced
from pipeline.coverage.training_views import render_training_views
from pipeline.render import RasterOptions, make_backend
from pipeline.render.contributions import contributions, in_grey
from pipeline.render.views import raster_camera, render_view
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians

#: Number of cameras that are moved, evenly spaced.
MAX_CAMERAS = 60
#: A Gaussian is removed if it covers this many times more of a novel view than of the training view
#: that shows it second best. What is as near to a novel view as this is seen by two training views
#: at less than three times the distance, if it is there.
MIN_RATIO = 8.0
#: A training view shows a Gaussian if it sees this share of what it would see without any other.
#: A Gaussian that so many training views show is not removed.
MIN_VISIBLE, SHOWN_BY = 0.25, 4
#: A Gaussian that covers a smaller share of a novel view hides nothing.
MIN_SHARE = 1e-5


def hides_free_places(
    gaussians: Gaussians, views: Sequence[View], up: Doubles, options: RasterOptions
) -> Tensor:
    """(N,) bool: Gaussians that stand in empty space (``contradictions.empty_depth``) before a
    novel view, and that training views do not show there.

    Args:
        views: All views; test views are not used.
        up: (3,) up vector of the world.
        options: How views are rendered. The number of threads does not affect results.
    """
    training = render_training_views(views, lambda view: render_view(gaussians, view, options))
    if training is None:
        return torch.zeros(len(gaussians), dtype=torch.bool)
    covered = torch.zeros(len(gaussians))
    agreed = training.surface.agreed(MIN_AGREEING)
    grey, options = in_grey(gaussians), replace(options, sh_degree=0, background=None)
    for novel in free_novel_views(training, up, MAX_CAMERAS):
        view = reduced(novel.view)
        near = _near(gaussians, view, empty_depth(view, agreed))
        if len(near):
            share = _shares(grey.select(near), view, options)
            covered[near] = torch.maximum(covered[near], share)
    candidates = torch.nonzero(covered > MIN_SHARE)[:, 0]
    covered = covered[candidates]
    shown_by = torch.zeros(len(candidates), dtype=torch.int64)
    # The largest shares in training views, in decreasing order.
    largest = torch.zeros(MIN_AGREEING, len(candidates))
    for probe in training.probes if len(candidates) else ():
        share = _shares(grey, probe.view, options)[candidates]
        alone = _shares(grey.select(candidates), probe.view, options)
        shown_by += (alone > MIN_SHARE / MIN_RATIO) & (share > MIN_VISIBLE * alone)
        for row in largest:
            larger = torch.maximum(row, share)
            share = torch.minimum(row, share)
            row.copy_(larger)
    hiding = torch.zeros(len(gaussians), dtype=torch.bool)
    hiding[candidates] = (shown_by < SHOWN_BY) & (covered > MIN_RATIO * largest[-1])
    return hiding


def _near(gaussians: Gaussians, view: View, depth: float) -> Tensor:
    """(M,) indices of the Gaussians with a camera z between 0 and ``depth``."""
    means = gaussians.arrays()["means"]
    offset = means - view.centre.astype(np.float32)
    x, y, z = view.world_to_camera[2, :3].astype(np.float32)
    ahead = offset[:, 0] * x + offset[:, 1] * y + offset[:, 2] * z
    return torch.from_numpy(np.flatnonzero((ahead > 0) & (ahead < depth)))


def _shares(grey: Gaussians, view: View, options: RasterOptions) -> Tensor:
    """(N,) the share of the image that each Gaussian explains."""
    camera = raster_camera(view)
    pixel = 1 / (camera.width * camera.height)
    return contributions(grey, camera, options, pixel, make_backend())
