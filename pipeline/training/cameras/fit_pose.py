"""The pose of a test view, fitted to its photograph in a scene that stays as it is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.render import Backend, RasterOptions, make_backend
from pipeline.render.views import limit_sh_degree, raster_camera
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.training.cameras.poses import Poses

# A held-out camera is fitted in so many looks; the rate falls from the first to the last by this.
FIT_STEPS, FIT_RATE, FIT_FALL = 100, 5e-3, 0.01


def fit_pose(
    gaussians: Gaussians,
    view: View,
    photo: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None,
    gain: Sequence[float] | None,
    options: RasterOptions,
    extent: float,
    ssim_weight: float,
    backend: Backend | None = None,
) -> View:
    """A held-out view with its pose moved to where the scene fits its photograph best; the scene
    stays as it is.

    Args:
        photo: (H, W, 3), over the background of ``options``.
        mask: (H, W), false where a pixel counts for nothing.
        gain: a factor for each channel of the render.
        backend: that draws; None: the default.
    """
    backend = backend or make_backend()
    options = limit_sh_degree(options, gaussians)
    poses = Poses.of([view], gaussians, extent)
    camera = raster_camera(view)
    wanted = torch.from_numpy(np.ascontiguousarray(photo))
    ignored = None if mask is None else torch.from_numpy(~mask)
    factor = torch.tensor([1.0, 1.0, 1.0] if gain is None else list(gain), dtype=torch.float32)
    best, least = poses.poses[0].copy(), math.inf
    for number in range(FIT_STEPS):
        rendered = backend.forward(*gaussians.parameters(), poses.camera(camera, 0), options)
        loss = backend.l1_ssim(
            rendered.color * factor, wanted, ssim_weight, ignored, threads=options.threads
        )
        if loss.loss < least:
            best, least = poses.poses[0].copy(), loss.loss
        d_color = loss.grad * factor
        found = backend.backward(rendered, d_color, means2d_abs=False, camera=True)
        assert found.camera is not None
        poses.step(0, found.camera, FIT_RATE * FIT_FALL ** (number / (FIT_STEPS - 1)))
    return replace(view, world_to_camera=best)
