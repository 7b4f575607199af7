"""The number of pixels of a view that each Gaussian explains."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pipeline.render import Backend, RasterCamera, RasterOptions
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.init import SH_C0


def in_grey(gaussians: Gaussians) -> Gaussians:
    """Return the same Gaussians, all of one colour, which no clamping changes."""
    grey = gaussians.with_sh_degree(0)
    return replace(grey, sh=torch.zeros_like(grey.sh))


def contributions(
    grey: Gaussians, camera: RasterCamera, options: RasterOptions, pixel: float, backend: Backend
) -> Tensor:
    """(N,) float32 sum over pixels of alpha times transmittance: the gradient of the sum of the
    image with respect to the Gaussian's colour.

    Args:
        grey: The result of ``in_grey``.
        options: Options of SH degree 0 and without a background.
        pixel: The area of one pixel of the camera, in pixels of the view.
    """
    rendered = backend.forward(*grey.parameters(), camera, options)
    d_color = torch.full((camera.height, camera.width, 3), pixel / SH_C0)
    return backend.backward(rendered, d_color).sh[:, 0, 0]
