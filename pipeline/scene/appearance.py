"""The appearance of a trained scene in photographs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Appearance:
    """How the colours of Gaussians differ between photographs (``training.appearance``).

    Attributes:
        colors: (N, K, 3) float32, added to SH coefficient 0 in proportion to an embedding.
        embeddings: (K,) embedding of each training view by name, of mean 0.
        gains: (3,) factor of the colours in each training view by name: its exposure and white
            balance, relative to the scene's typical ones. Empty if there are none.
    """

    colors: NDArray[np.float32]
    embeddings: dict[str, NDArray[np.float64]]
    gains: dict[str, NDArray[np.float64]] = field(default_factory=dict)


def fitted_columns(width: int) -> int:
    """Number of columns of a test photograph on which its appearance is fitted: the left half."""
    return width // 2
