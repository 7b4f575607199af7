"""Adam (Kingma and Ba 2015) for the parameters of cameras, one camera in each step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


@dataclass
class PerCameraAdam:
    """The moments of each camera.

    Attributes:
        shape: The numbers of cameras and of parameters of each.
        first, second: The moments, of that shape.
        steps: (cameras,) int64, the number of steps of each camera.
    """

    shape: tuple[int, int]
    first: Array = field(init=False)
    second: Array = field(init=False)
    steps: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.first, self.second = np.zeros(self.shape), np.zeros(self.shape)
        self.steps = np.zeros(self.shape[0], np.int64)

    def step(self, camera: int, gradient: Array, rate: float) -> Array:
        """(parameters,) change of one camera's parameters; ``rate`` each in the first step."""
        self.steps[camera] += 1
        steps = int(self.steps[camera])
        self.first[camera] += (1 - BETA1) * (gradient - self.first[camera])
        self.second[camera] += (1 - BETA2) * (gradient**2 - self.second[camera])
        mean = self.first[camera] / (1 - BETA1**steps)
        spread = np.sqrt(self.second[camera] / (1 - BETA2**steps))
        return np.asarray(-rate * mean / (spread + EPSILON))

    def arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """The arrays of a checkpoint."""
        return {
            f"{prefix}.first": self.first,
            f"{prefix}.second": self.second,
            f"{prefix}.steps": self.steps,
        }

    def restore(self, prefix: str, arrays: dict[str, NDArray[Any]]) -> None:
        self.first, self.second = arrays[f"{prefix}.first"], arrays[f"{prefix}.second"]
        self.steps = arrays[f"{prefix}.steps"]
