"""Gaussians in a ``.npz`` file of numpy: the five arrays of ``Gaussians``, float32, without loss.

The stages exchange this format.
"""

from __future__ import annotations

from pathlib import Path

from pipeline.io.arrays import read_archive, write_arrays
from pipeline.io.bounded import opened_regular
from pipeline.runtime.errors import UserError
from pipeline.runtime.record import owner_of, rerun
from pipeline.splats.gaussians import Gaussians


def write_npz(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians, atomically and deterministically."""
    write_arrays(path, gaussians.arrays())


def read_npz(path: Path) -> Gaussians:
    """Read Gaussians.

    Raises:
        UserError: the file is missing, damaged, or not a file of Gaussians.
    """
    try:
        with opened_regular(path) as file:
            arrays = read_archive(file)
        gaussians = Gaussians.from_arrays(arrays)
    except KeyError as error:
        raise _wrong(path, f"expected a file of Gaussians, found no array {error}") from None
    except OSError as error:
        raise _wrong(path, f"cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise _wrong(path, f"expected a file of Gaussians, could not read it: {error}") from None
    n = len(gaussians) if gaussians.means.ndim else 0
    k = (min(max(gaussians.sh_degree, 0), 3) + 1) ** 2 if gaussians.sh.ndim > 1 else 1
    shapes = {name: tuple(tensor.shape) for name, tensor in gaussians.tensors().items()}
    expected = {
        "means": (n, 3),
        "log_scales": (n, 3),
        "quats": (n, 4),
        "opacity_logits": (n,),
        "sh": (n, k, 3),
    }
    if shapes != expected:
        raise _wrong(path, f"expected arrays of Gaussians of shapes {expected}, found {shapes}")
    return gaussians


def _wrong(path: Path, what: str) -> UserError:
    folder = owner_of(path)
    fix = "write the file again, or get an intact copy of it" if folder is None else rerun(folder)
    return UserError(what, file=path, fix=fix)
