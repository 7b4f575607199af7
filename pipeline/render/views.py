"""Rendering Gaussians into views, for evaluation and for looking at."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.render import Backend, Forward, RasterCamera, RasterOptions, make_backend
from pipeline.scene.views import View, reduced_size
from pipeline.splats.gaussians import Gaussians


class Render(NamedTuple):
    """One picture.

    Attributes:
        rgb: (H, W, 3) float32, over the background, clamped to [0, 1].
        alpha: (H, W) float32 in [0, 1].
        depth: (H, W) float32, camera z summed by weight, not divided by alpha; world unit.
        median_depth: (H, W) float32, camera z of the Gaussian that takes the transmittance below
            one half; 0 where none does.
    """

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    median_depth: NDArray[np.float32]


def near_plane(extent: float) -> float:
    """The near plane's distance for a scene of size ``extent``, both in the world's unit: what is
    nearer to a camera than this share of the cameras' spread is a floater."""
    return 0.01 * extent


def raster_camera(view: View, factor: int = 1) -> RasterCamera:
    """The rasterizer's camera for a view at 1 / ``factor`` of its size."""
    width, height = reduced_size(view, factor)
    sx, sy = width / view.width, height / view.height
    return RasterCamera(
        width,
        height,
        view.fx * sx,
        view.fy * sy,
        view.cx * sx,
        view.cy * sy,
        torch.from_numpy(np.ascontiguousarray(view.world_to_camera, np.float64)),
    )


def within(options: RasterOptions, gaussians: Gaussians) -> RasterOptions:
    """The options with no higher degree of harmonics than the Gaussians have."""
    return replace(options, sh_degree=min(options.sh_degree, gaussians.sh_degree))


def render_view(
    gaussians: Gaussians,
    view: View,
    options: RasterOptions | None = None,
    backend: Backend | None = None,
) -> Render:
    """Render ``gaussians`` as ``view`` sees them, at the view's size."""
    result = _forward(gaussians, view, options, backend)
    return Render(
        result.color.clamp(0.0, 1.0).numpy(),
        result.alpha.numpy(),
        result.depth.numpy(),
        result.median_depth.numpy(),
    )


def render_rgb(
    gaussians: Gaussians,
    view: View,
    options: RasterOptions | None = None,
    backend: Backend | None = None,
) -> NDArray[np.float32]:
    """The colours of ``render_view`` alone, without the time that depths take."""
    result = _forward(gaussians, view, options, backend)
    return np.asarray(result.color.clamp(0.0, 1.0).numpy())


def _forward(
    gaussians: Gaussians, view: View, options: RasterOptions | None, backend: Backend | None
) -> Forward:
    options = within(options or RasterOptions(), gaussians)
    backend = backend or make_backend()
    return backend.forward(*gaussians.parameters(), raster_camera(view), options)


def to_bytes(image: Any) -> NDArray[np.uint8]:
    """[0, 1] floats to 8 bit, rounded."""
    return np.rint(np.clip(np.asarray(image), 0, 1) * 255).astype(np.uint8)
