"""Gaussians in a ``.npz`` file of numpy: the five arrays of ``Gaussians``, float32, without loss.

The stages exchange this format.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from pipeline.io.arrays import read_archive, write_chunks
from pipeline.io.bounded import opened_regular
from pipeline.io.splat_codec import FIX
from pipeline.runtime.errors import UserError
from pipeline.runtime.record import owner_of, rerun
from pipeline.splats.arrays import NAMES, GaussianArrays, GaussianSource, array_shapes
from pipeline.splats.gaussians import Gaussians


def write_npz(path: Path, gaussians: GaussianSource) -> None:
    """Write Gaussians chunk by chunk, atomically and deterministically."""
    shapes = array_shapes(len(gaussians), gaussians.sh_degree)
    write_chunks(
        path,
        {
            name: (shape, (values for (values,) in gaussians.chunks(name)))
            for name, shape in shapes.items()
        },
    )


def read_npz(path: Path) -> Gaussians:
    """Read Gaussians as tensors; see ``read_gaussian_arrays``."""
    return Gaussians.sharing(read_gaussian_arrays(path))


def read_gaussian_arrays(path: Path) -> GaussianArrays:
    """Read Gaussians.

    Raises:
        UserError: the file is missing, damaged, or not a file of Gaussians.
    """
    try:
        with opened_regular(path) as file:
            arrays = read_archive(file)
        single = {name: np.asarray(arrays.pop(name), np.float32, order="C") for name in NAMES}
    except KeyError as error:
        raise _wrong(path, f"expected a file of Gaussians, found no array {error}") from None
    except OSError as error:
        raise _wrong(path, f"cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise _wrong(path, f"expected a file of Gaussians, could not read it: {error}") from None
    shapes = {name: array.shape for name, array in single.items()}
    means, sh = shapes["means"], shapes["sh"]
    degree = math.isqrt(sh[1]) - 1 if len(sh) > 1 else 0
    expected = array_shapes(means[0] if means else 0, min(max(degree, 0), 3))
    if shapes != expected:
        raise _wrong(path, f"expected arrays of Gaussians of shapes {expected}, found {shapes}")
    return GaussianArrays(**single)


def _wrong(path: Path, what: str) -> UserError:
    folder = owner_of(path)
    fix = FIX if folder is None else rerun(folder)
    return UserError(what, file=path, fix=fix)
