"""Helpers for the file formats of Gaussians: encoding of values in bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FIX = "check the path; write the file again, or get an intact copy of it"


def to_uint8(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Round and clamp to 0..255."""
    return np.rint(values).clip(0, 255).astype(np.uint8)


def sigmoid(logits: NDArray[Any]) -> NDArray[np.float64]:
    """1 / (1 + exp(-x)) in float64, without overflow."""
    return 1 / (1 + np.exp(-np.float64(logits).clip(-100, 100)))


def logit(opacities: NDArray[Any], margin: float) -> NDArray[np.float64]:
    """The inverse of the sigmoid, of opacities clamped to [``margin``, 1 - ``margin``]."""
    p = np.float64(opacities).clip(margin, 1 - margin)
    return np.log(p / (1 - p))


def logit_of_byte(opacities: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Logits of opacities in 8 bits, clamped to a quarter of a step from 0 and 1."""
    return logit(opacities / 255, 0.25 / 255)
