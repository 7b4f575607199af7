"""Fits invented Gaussians to the painted holes. All other Gaussians stay as they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render import AdamRates, Backend, Moments, RasterOptions, make_backend
from pipeline.render.contributions import contributions, in_grey
from pipeline.render.views import limit_sh_degree, raster_camera
from pipeline.runtime.progress import track
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians, concat
from pipeline.splats.init import SH_C0

#: The number of steps, one painted view each.
STEPS = 300
#: Adam's learning rates of the colours (coefficients of SH), the logarithms of the scales and the
#: logits of the opacities. Positions stay: paintings have no parallax.
COLOUR_RATE, SCALE_RATE, OPACITY_RATE = 0.01, 0.005, 0.02
#: An invented Gaussian may cover this many pixels of a training view, and all of them together this
#: share of it.
MAX_SHOWN_PX, MAX_SHOWN_SHARE = 0.2, 0.001


@dataclass(frozen=True)
class PaintedView:
    """A view whose holes are painted.

    Attributes:
        view: The camera, at the size of the picture.
        picture: (H, W, 3) uint8 RGB.
        hole: (H, W) True in painted pixels.
    """

    view: View
    picture: NDArray[np.uint8]
    hole: NDArray[np.bool_]


def fit_invented(
    scene: Gaussians, invented: Gaussians, painted: Sequence[PaintedView], options: RasterOptions
) -> Gaussians:
    """The invented Gaussians with colours, scales and opacities that minimise the L1 loss of the
    painted views over their holes.

    Args:
        scene: The other Gaussians, of the same SH degree.
        options: How views are rendered. The number of threads does not affect results.
    """
    backend, options = make_backend(), limit_sh_degree(options, scene)
    fitted, first = invented.clone(), len(scene)
    colours = fitted.sh[:, 0].contiguous()
    rated = (
        (colours, COLOUR_RATE),
        (fitted.log_scales, SCALE_RATE),
        (fitted.opacity_logits, OPACITY_RATE),
    )
    moments = [Moments(torch.zeros_like(t), torch.zeros_like(t)) for t, _ in rated]
    pictures = [(torch.from_numpy(view.picture), torch.from_numpy(~view.hole)) for view in painted]
    for step in track(range(STEPS), "fitting invented Gaussians", STEPS, unit="steps"):
        number = step % len(painted)
        fitted.sh[:, 0] = colours
        rendered = backend.forward(
            *concat([scene, fitted]).parameters(), raster_camera(painted[number].view), options
        )
        picture, ignored = pictures[number]
        loss = backend.l1_ssim(rendered.color, picture, 0.0, ignored, 0.0, options.threads)
        found = backend.backward(rendered, loss.grad)
        gradients = found.sh[first:, 0], found.log_scales[first:], found.opacity_logits[first:]
        for (tensor, rate), gradient, moment in zip(rated, gradients, moments, strict=True):
            rates = AdamRates(rate * (1 - step / STEPS), step + 1)
            backend.adam_step(tensor, gradient.contiguous(), moment, rates, options.threads)
    fitted.sh[:, 0] = colours
    return fitted


def without_shown(
    scene: Gaussians, invented: Gaussians, views: Sequence[View], options: RasterOptions
) -> Gaussians:
    """The invented Gaussians that no view shows: each covers at most ``MAX_SHOWN_PX`` pixels of
    each view, and all together at most ``MAX_SHOWN_SHARE`` of it.

    Args:
        views: The training views.
    """
    backend = make_backend()
    options = replace(options, sh_degree=0, background=None)
    for view in track(views, "checking training views", len(views), unit="views"):
        if not len(invented):
            break
        both = in_grey(concat([scene, invented]))
        shown = contributions(both, raster_camera(view), options, 1.0, backend)[len(scene) :]
        # The Gaussians that cover least are kept, up to the sum that is allowed.
        ascending = torch.argsort(shown, stable=True)
        total = torch.from_numpy(np.cumsum(shown[ascending].numpy().astype(np.float64)))
        allowed = total <= MAX_SHOWN_SHARE * view.width * view.height
        kept = torch.zeros(len(invented), dtype=torch.bool)
        kept[ascending] = allowed & (shown[ascending] <= MAX_SHOWN_PX)
        invented = invented.select(kept)
    return invented


def invented_weight(
    gaussians: Gaussians, first: int, view: View, options: RasterOptions, backend: Backend
) -> NDArray[np.float32]:
    """(H, W) the share of each pixel's colour, 0 to 1, that invented Gaussians have.

    Args:
        first: The index of the first invented Gaussian; all others follow it.
    """
    options = replace(options, sh_degree=0, background=None)
    white: Tensor = torch.full((len(gaussians), 1, 3), -0.5 / SH_C0)
    white[first:] = 0.5 / SH_C0
    marked = replace(gaussians, sh=white)
    rendered = backend.forward(*marked.parameters(), raster_camera(view), options)
    return np.asarray(rendered.color[..., 0].clamp(0.0, 1.0).numpy())
