"""Measures what files of Gaussians lose: their renders against those of the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.export.counters import FileLoss
from pipeline.io.splat_files import read_gaussians
from pipeline.metrics.image import psnr
from pipeline.render import RasterOptions
from pipeline.render.views import render_rgb
from pipeline.scene.views import View, evenly_spaced
from pipeline.splats.arrays import GaussianSource, collect
from pipeline.splats.gaussians import Gaussians

Picture = NDArray[np.float32]

# The largest number of views that are rendered.
_VIEWS = 4


def measure_losses(
    files: Sequence[Path], gaussians: GaussianSource, views: Sequence[View], options: RasterOptions
) -> list[FileLoss]:
    """Compare the renders of each file, as it is read, with those of ``gaussians``.

    Args:
        files: Files of the Gaussians, in the world of ``views``.
        views: The views to render; up to four of them, evenly spaced, are.
        options: The options of the rasterizer (``Protocol.options``).
    """
    chosen = evenly_spaced(views, _VIEWS)
    # One copy of the Gaussians is held at a time.
    expected = _renders(Gaussians.sharing(collect(gaussians)), chosen, options)
    return [_loss(file, expected, chosen, options) for file in files]


def _loss(
    file: Path, expected: list[Picture], views: Sequence[View], options: RasterOptions
) -> FileLoss:
    found = _renders(read_gaussians(file, []), views, options)
    values = [psnr(image, reference) for image, reference in zip(found, expected, strict=True)]
    size_mb = round(file.stat().st_size / 1e6, 3)
    return FileLoss(file=file.name, size_mb=size_mb, psnr=float(np.mean(values)))


def _renders(gaussians: Gaussians, views: Sequence[View], options: RasterOptions) -> list[Picture]:
    return [render_rgb(gaussians, view, options) for view in views]
