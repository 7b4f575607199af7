"""Appearance embeddings before training, from the colours of whole photographs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.photos.load import load_view
from pipeline.scene.views import View

Array = NDArray[np.float64]


def initial_embeddings(views: Sequence[View], size: int) -> Array:
    """(V, size) principal components of the photographs' statistics: photographs in similar light
    start with similar embeddings.

    The statistics are the mean and the standard deviation of each channel over the unmasked pixels.
    The first component has a standard deviation of 1 over the views, or all are 0 if the
    photographs have the same statistics.

    Args:
        size: The number of values, at most 6.
    """
    statistics = np.array([_statistics(view) for view in views])
    statistics -= statistics.mean(0)
    # Avoid a matrix product: BLAS may round differently with the number of threads.
    covariance = np.einsum("vi,vj->ij", statistics, statistics) / len(views)
    variances, axes = np.linalg.eigh(covariance)
    axes = axes[:, ::-1][:, :size]
    axes *= np.where(axes[np.abs(axes).argmax(0), range(size)] < 0, -1, 1)
    components = np.einsum("vi,ik->vk", statistics, axes)
    return components / max(float(np.sqrt(max(variances[-1], 0))), 1e-6)


def _statistics(view: View) -> Array:
    pixels = load_view(view)
    rgb = pixels.rgb.reshape(-1, 3) if pixels.mask is None else pixels.rgb[pixels.mask]
    if not len(rgb):
        return np.zeros(6)
    values = rgb / 255.0
    return np.concatenate([values.mean(0), values.std(0)])
