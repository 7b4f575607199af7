"""Render scenes from views, for evaluation and display. Importing this module does not import
torch."""

from __future__ import annotations

import io
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.render import Forward, RasterCamera, RasterOptions
from pipeline.runtime.atomic import write_bytes
from pipeline.scene.views import View, reduced_size
from pipeline.splats.gaussians import Gaussians

if TYPE_CHECKING:
    from pipeline.render import Backend


class Render(NamedTuple):
    """A rendered view.

    Attributes:
        rgb: (H, W, 3) float32 over the background, clamped to [0, 1].
        alpha: (H, W) float32 in [0, 1].
        depth: (H, W) float32 sum of weight * camera z in world units, not divided by alpha.
        median_depth: (H, W) float32 camera z of the Gaussian at which the transmittance falls below
            0.5; 0 if it does not.
    """

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    median_depth: NDArray[np.float32]

    def __repr__(self) -> str:
        height, width = self.alpha.shape
        return f"Render({width}x{height} pixels)"

    def save(self, file: str | PathLike[str]) -> None:
        """Write the colours as an 8-bit PNG file."""
        write_png(Path(file), to_bytes(self.rgb))


def near_plane(extent: float) -> float:
    """Distance of the near plane in world units, for a scene with this ``scene_extent``. Gaussians
    closer to a camera are floaters and not rendered."""
    return 0.01 * extent


def raster_camera(view: View, factor: int = 1) -> RasterCamera:
    """The rasterizer's camera of a view, downscaled by ``factor``."""
    import torch

    width, height = reduced_size(view, factor)
    sx, sy = width / view.width, height / view.height
    crop, part_of = view.crop, None
    pose = torch.from_numpy(np.ascontiguousarray(view.world_to_camera, np.float64))
    focal = view.fx * sx, view.fy * sy
    if crop is not None:
        whole = round(crop.full_width * sx), round(crop.full_height * sy)
        centre = (view.cx + crop.left) * sx, (view.cy + crop.top) * sy
        part_of = RasterCamera(*whole, *focal, *centre, pose)
    return RasterCamera(width, height, *focal, view.cx * sx, view.cy * sy, pose, part_of)


def limit_sh_degree(options: RasterOptions, gaussians: Gaussians) -> RasterOptions:
    """The options with the SH degree limited to that of the Gaussians."""
    return replace(options, sh_degree=min(options.sh_degree, gaussians.sh_degree))


def render_view(
    gaussians: Gaussians,
    view: View,
    options: RasterOptions | None = None,
    backend: Backend | None = None,
) -> Render:
    """Render ``gaussians`` from ``view``, at the view's size."""
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
    """Render only the colours of ``render_view``; faster, since no depths are rendered."""
    result = _forward(gaussians, view, options, backend)
    return np.asarray(result.color.clamp(0.0, 1.0).numpy())


def _forward(
    gaussians: Gaussians, view: View, options: RasterOptions | None, backend: Backend | None
) -> Forward:
    from pipeline.render import make_backend

    options = limit_sh_degree(options or RasterOptions(), gaussians)
    backend = backend or make_backend()
    return backend.forward(*gaussians.parameters(), raster_camera(view), options)


def to_bytes(image: Any) -> NDArray[np.uint8]:
    """Convert floats in [0, 1] to uint8, rounded."""
    scaled = np.clip(np.asarray(image), 0, 1)
    scaled *= 255
    return np.rint(scaled, out=scaled).astype(np.uint8)


def write_png(file: Path, image: NDArray[np.uint8]) -> None:
    """Write an image (H, W, 3) as PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    write_bytes(file, buffer.getvalue())
