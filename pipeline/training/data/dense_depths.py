"""Samples of the depth maps of multi-view stereo."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.mvs.maps import read_map
from pipeline.scene.views import View
from pipeline.training.data.depth_maps import merged
from pipeline.training.data.known_depths import KnownDepths

#: Grid points per view; those of unknown depth are left out.
SAMPLES = 10_000


def add_dense_depths(
    views: Sequence[View], points: Sequence[KnownDepths], folder: Path
) -> list[KnownDepths]:
    """``points`` with samples of the views' dense depth maps, whose weights are their confidences.

    Args:
        folder: The folder with the outputs of the stage dense.

    Raises:
        UserError: A depth map is missing or damaged.
    """
    return [merged(own, _samples(view, folder)) for view, own in zip(views, points, strict=True)]


def _samples(view: View, folder: Path) -> KnownDepths:
    found = read_map(folder, view.name)
    step = max(1.0, np.sqrt(view.width * view.height / SAMPLES))
    x, y = np.meshgrid(
        np.arange(step / 2, view.width, step).astype(int),
        np.arange(step / 2, view.height, step).astype(int),
    )
    known = found.depth[y, x] > 0
    x, y = x[known], y[known]
    xy = np.stack([x, y], axis=1) + 0.5
    return KnownDepths(xy, found.depth[y, x], found.confidence[y, x])
