"""Adam (Kingma and Ba 2015) for a table of few parameters, of which each step moves one row."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


@dataclass
class RowAdam:
    """The rows' moments.

    Attributes:
        shape: (rows, parameters).
        first, second: of that shape.
        steps: (rows,) int64, of each row.
    """

    shape: tuple[int, int]
    first: Array = field(init=False)
    second: Array = field(init=False)
    steps: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.first, self.second = np.zeros(self.shape), np.zeros(self.shape)
        self.steps = np.zeros(self.shape[0], np.int64)

    def step(self, row: int, gradient: Array, rate: float) -> Array:
        """(parameters,) what to add to the row; at first ``rate`` for each of them."""
        self.steps[row] += 1
        steps = int(self.steps[row])
        self.first[row] += (1 - BETA1) * (gradient - self.first[row])
        self.second[row] += (1 - BETA2) * (gradient**2 - self.second[row])
        mean = self.first[row] / (1 - BETA1**steps)
        spread = np.sqrt(self.second[row] / (1 - BETA2**steps))
        return np.asarray(-rate * mean / (spread + EPSILON))

    def arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """What a checkpoint must hold."""
        return {
            f"{prefix}.first": self.first,
            f"{prefix}.second": self.second,
            f"{prefix}.steps": self.steps,
        }

    def restore(self, prefix: str, arrays: dict[str, NDArray[Any]]) -> None:
        self.first, self.second = arrays[f"{prefix}.first"], arrays[f"{prefix}.second"]
        self.steps = arrays[f"{prefix}.steps"]
