"""Alignment of a test view to its photograph, in a fixed scene."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.render import RasterOptions, make_backend
from pipeline.render.views import limit_sh_degree, raster_camera
from pipeline.scene.exposure import ViewLight
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.training.cameras.poses import PoseRefinement

# Number of steps, learning rate of the first (radians, extents), and of the last relative to it.
FIT_STEPS, FIT_RATE, FIT_DECAY = 100, 5e-3, 0.01


def fit_pose(
    gaussians: Gaussians,
    view: View,
    photo: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None,
    light: ViewLight | None,
    options: RasterOptions,
    extent: float,
    ssim_weight: float,
) -> View:
    """The view with the pose at which the render of the fixed scene is closest to its photograph.

    Args:
        photo: (H, W, 3) colours over the background of ``options``.
        mask: (H, W) bool, False for ignored pixels.
        light: The light of the photograph, by which the render is multiplied.
        extent: The unit of translations (``scene.views.scene_extent``), world units.
        ssim_weight: The weight of SSIM in the loss, as in training.
    """
    backend = make_backend()
    options = limit_sh_degree(options, gaussians)
    poses = PoseRefinement.of([view], gaussians, extent, limit=math.inf)
    camera = raster_camera(view)
    target = torch.from_numpy(np.ascontiguousarray(photo))
    ignored = None if mask is None else torch.from_numpy(~mask)
    factor = torch.ones(3) if light is None else torch.from_numpy(light.factor(view))
    best, least = poses.poses[0].copy(), math.inf
    for number in range(FIT_STEPS):
        rendered = backend.forward(*gaussians.parameters(), poses.camera(camera, 0), options)
        loss = backend.l1_ssim(
            rendered.color * factor, target, ssim_weight, ignored, threads=options.threads
        )
        if loss.loss < least:
            best, least = poses.poses[0].copy(), loss.loss
        d_color = loss.grad * factor
        gradients = backend.backward(rendered, d_color, camera=True).camera
        assert gradients is not None
        poses.step(0, gradients, FIT_RATE * FIT_DECAY ** (number / (FIT_STEPS - 1)))
    return replace(view, world_to_camera=best)
