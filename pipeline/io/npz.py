"""Gaussians in a ``.npz`` file of numpy: the five arrays of ``Gaussians``, float32, without loss.

The stages exchange this format.
"""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np

from pipeline.io.arrays import write_arrays
from pipeline.runtime.errors import UserError
from pipeline.splats.gaussians import Gaussians

FIX = "delete the file and run again"


def write_npz(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians, atomically and deterministically."""
    write_arrays(path, gaussians.arrays())


def read_npz(path: Path) -> Gaussians:
    """Read Gaussians.

    Raises:
        UserError: the file is missing, damaged, or not a file of Gaussians.
    """
    try:
        with np.load(path) as archive:
            gaussians = Gaussians.from_arrays({name: archive[name] for name in archive.files})
        n, k = gaussians.means.shape[0], (min(gaussians.sh_degree, 3) + 1) ** 2
    except (
        *(OSError, ValueError, KeyError, IndexError, EOFError, TypeError),
        *(zipfile.BadZipFile, zlib.error),
    ) as error:
        raise UserError(
            f"expected a file of Gaussians, could not read it: {error}", file=path, fix=FIX
        ) from error
    shapes = {name: tuple(tensor.shape) for name, tensor in gaussians.tensors().items()}
    expected = {
        "means": (n, 3),
        "log_scales": (n, 3),
        "quats": (n, 4),
        "opacity_logits": (n,),
        "sh": (n, k, 3),
    }
    if shapes != expected:
        raise UserError(
            f"expected arrays of Gaussians of shapes {expected}, found {shapes}",
            file=path,
            fix=FIX,
        )
    return gaussians
