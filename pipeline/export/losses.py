"""Measures what files of Gaussians lose: their renders against those of the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.export.counters import FileLoss
from pipeline.io.splat_files import read_gaussians
from pipeline.metrics.image import psnr
from pipeline.render import RasterOptions
from pipeline.render.views import render_rgb
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians

# The largest number of views that are rendered.
_VIEWS = 4


def measure_losses(
    files: Sequence[Path], gaussians: Gaussians, views: Sequence[View], options: RasterOptions
) -> list[FileLoss]:
    """Compare the renders of each file, as it is read, with those of ``gaussians``.

    Args:
        files: Files of the Gaussians, in the world of ``views``.
        views: The views to render; up to four of them, evenly spaced, are.
        options: The options of the rasterizer (``Protocol.options``).
    """
    count = min(_VIEWS, len(views))
    chosen = [views[i * len(views) // count] for i in range(count)]
    expected = [render_rgb(gaussians, view, options) for view in chosen]
    found = []
    for file in files:
        read = read_gaussians(file, [])
        values = [
            psnr(render_rgb(read, view, options), render)
            for view, render in zip(chosen, expected, strict=True)
        ]
        size_mb = round(file.stat().st_size / 1e6, 3)
        found.append(FileLoss(file=file.name, size_mb=size_mb, psnr=float(np.mean(values))))
    return found
