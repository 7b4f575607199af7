"""Helpers for the file formats of Gaussians: reading files and encoding values in bytes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.io.bounded import memory_share, opened_regular, too_large
from pipeline.runtime.errors import UserError


def read_file(path: Path, kind: str) -> bytes:
    """The bytes of a file.

    Args:
        kind: what the error message expects ("an SPZ file").

    Raises:
        UserError: the file cannot be read, or is larger than half of the memory.
    """
    try:
        with opened_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size <= memory_share():
                return file.read(size)
    except OSError as error:
        raise UserError(
            f"expected {kind}, could not read it: {error.strerror}",
            file=path,
            fix="check the path and its permissions",
        ) from error
    raise too_large(path, size)


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
