"""Writing arrays as a ``.npz`` file. Importing this module does not import torch."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.atomic import write_bytes


def write_arrays(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Write a ``.npz`` file of float32 arrays, atomically and deterministically."""
    buffer = io.BytesIO()
    single = {name: np.asarray(array, np.float32, order="C") for name, array in arrays.items()}
    # Deterministic: numpy writes a fixed date into its archives.
    np.savez(buffer, **single)  # type: ignore[arg-type]
    write_bytes(path, buffer.getvalue())
