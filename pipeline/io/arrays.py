"""numpy's ``.npy`` and ``.npz`` files of numbers. Importing this module does not import torch.

Reading never takes more memory than the file's size allows, whatever its headers say, and never
runs code of the file (pickles).
"""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from pipeline.runtime.atomic import write_bytes

# Largest ratio of the arrays' bytes to those of their archive. Arrays of measured values compress
# less; a file that is made to exhaust the memory compresses a thousand times.
_MAX_EXPANSION = 100
_MAX_MEMBERS = 1000


def write_arrays(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Write a ``.npz`` file of float32 arrays, atomically and deterministically."""
    buffer = io.BytesIO()
    single = {name: np.asarray(array, np.float32, order="C") for name, array in arrays.items()}
    # Deterministic: numpy writes a fixed date into its archives.
    np.savez(buffer, **single)  # type: ignore[arg-type]
    write_bytes(path, buffer.getvalue())


def read_array(data: bytes) -> NDArray:
    """The array of a ``.npy`` file: integers, floats or bools.

    Raises:
        ValueError: not such a file, or its size differs from its header's.
    """
    file = io.BytesIO(data)
    try:
        version = npy.read_magic(file)
        read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        shape, fortran, dtype = read_header[version](file)
    # numpy parses the header as Python source, with exceptions of many types.
    except Exception:
        raise ValueError("expected an array of numpy (.npy), found no header of one") from None
    if dtype.kind not in "biuf":
        raise ValueError(f"expected an array of numbers, found {dtype}")
    if not all(type(side) is int and 0 <= side < 2**31 for side in shape) or len(shape) > 8:
        raise ValueError(f"expected an array of numbers, found the shape {str(shape)[:80]}")
    expected, found = math.prod(shape) * dtype.itemsize, len(data) - file.tell()
    if expected != found:
        raise ValueError(f"expected {expected} bytes of values after the header, found {found}")
    if expected == 0:
        return np.zeros(shape, dtype)
    values = np.frombuffer(data, dtype, offset=file.tell())
    return values.reshape(shape, order="F" if fortran else "C")


def read_archive(file: BinaryIO) -> dict[str, NDArray]:
    """The arrays of a ``.npz`` file by name, in the file's order.

    Raises:
        ValueError: not such a file, or one that would expand to many times its size.
    """
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    try:
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            total = sum(member.file_size for member in members)
            if len(members) > _MAX_MEMBERS or total > _MAX_EXPANSION * size:
                raise ValueError(
                    f"expected at most {_MAX_MEMBERS} arrays of at most {_MAX_EXPANSION} times the "
                    f"file's size, found {len(members)} arrays of {total} bytes"
                )
            if any(member.compress_size > size for member in members):
                raise ValueError("expected arrays in the archive, found one larger than the file")
            # zipfile stops at the size that the member's entry gives.
            return {
                member.filename.removesuffix(".npy"): read_array(archive.read(member))
                for member in members
            }
    # RuntimeError: encrypted; NotImplementedError: an unknown compression.
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError) as error:
        raise ValueError(f"expected an archive of numpy (.npz): {error}") from None
