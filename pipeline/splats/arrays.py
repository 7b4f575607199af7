"""The file of Gaussians as arrays, without torch, which takes seconds to import."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.atomic import write_bytes


def write_arrays(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Write a ``.npz`` file of float32; the same arrays always give the same bytes."""
    buffer = io.BytesIO()
    single = {name: np.asarray(array, np.float32, order="C") for name, array in arrays.items()}
    # numpy stamps the members of its archives with a fixed date.
    np.savez(buffer, **single)  # type: ignore[arg-type]
    write_bytes(path, buffer.getvalue())
