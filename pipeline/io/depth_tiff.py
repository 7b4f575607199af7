"""Depth maps as TIFF files."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

from pipeline.runtime.atomic import write_bytes


def write_depth_tiff(path: Path, depth: NDArray[np.float32]) -> None:
    """Write a depth map (H, W) as one channel of 32-bit floats, atomically."""
    buffer = io.BytesIO()
    # Write no metadata: libtiff warns about the order of the description tag.
    tifffile.imwrite(buffer, np.asarray(depth), compression="zlib", metadata=None)
    write_bytes(path, buffer.getvalue())
