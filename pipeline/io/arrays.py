"""numpy's ``.npy`` and ``.npz`` files of numbers. Importing this module does not import torch.

Reading never takes more memory than the file's size allows, whatever its headers say, and never
runs code of the file (pickles).
"""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from pipeline.runtime.atomic import written

# Largest ratio of the arrays' bytes to those of their archive. Arrays of measured values compress
# less; a file that is made to exhaust the memory compresses a thousand times.
_MAX_EXPANSION = 100
_MAX_MEMBERS = 1000
# The number of bytes that are read at a time.
_PIECE = 1 << 20


def write_arrays(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Write a ``.npz`` file of float32 arrays, atomically and deterministically."""
    write_chunks(path, {name: (array.shape, [array]) for name, array in arrays.items()})


def write_chunks(
    path: Path, arrays: Mapping[str, tuple[tuple[int, ...], Iterable[NDArray]]]
) -> None:
    """Write a ``.npz`` file of float32 arrays as numpy does, atomically and deterministically.

    Args:
        arrays: Name -> the shape of the array, and its parts along the first axis.
    """
    # Deterministic: entries that are opened by name have a fixed date.
    with written(path) as file, zipfile.ZipFile(file, "w") as archive:
        for name, (shape, parts) in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                header = {"descr": "<f4", "fortran_order": False, "shape": shape}
                npy.write_array_header_1_0(member, header)
                for part in parts:
                    member.write(np.ascontiguousarray(part, "<f4").data)


def read_array_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """The shape, whether the first axis varies fastest, and the type of a ``.npy`` file's array.

    Raises:
        Exception: The header is invalid; numpy parses the header as Python source, with exceptions
            of many types.
    """
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    shape, fortran, dtype = read[npy.read_magic(file)](file)
    return shape, fortran, dtype


def read_array(data: bytes) -> NDArray:
    """The array of a ``.npy`` file: integers, floats or bools.

    Raises:
        ValueError: The file is not of this kind, or its size differs from its header's.
    """
    return _read_array(io.BytesIO(data), len(data))


def _read_array(file: IO[bytes], size: int) -> NDArray:
    """The array of a ``.npy`` file of this size, read in pieces into its memory."""
    try:
        shape, fortran, dtype = read_array_header(file)
    except Exception:
        raise ValueError("expected an array of numpy (.npy), found no header of one") from None
    if dtype.kind not in "biuf":
        raise ValueError(f"expected an array of numbers, found {dtype}")
    if not all(type(side) is int and 0 <= side < 2**31 for side in shape) or len(shape) > 8:
        raise ValueError(f"expected an array of numbers, found the shape {str(shape)[:80]}")
    expected, found = math.prod(shape) * dtype.itemsize, size - file.tell()
    if expected != found:
        raise ValueError(f"expected {expected} bytes of values after the header, found {found}")
    values, start = np.empty(math.prod(shape), dtype), 0
    while piece := file.read(_PIECE):
        values.view(np.uint8)[start : start + len(piece)] = np.frombuffer(piece, np.uint8)
        start += len(piece)
    if start != expected:
        raise ValueError(f"expected {expected} bytes of values after the header, found {start}")
    return values.reshape(shape, order="F" if fortran else "C")


def read_archive(file: BinaryIO) -> dict[str, NDArray]:
    """The arrays of a ``.npz`` file by name, in the file's order.

    Raises:
        ValueError: The file is not of this kind, or would expand to many times its size.
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
            arrays = {}
            for member in members:
                with archive.open(member) as entry:
                    name = member.filename.removesuffix(".npy")
                    arrays[name] = _read_array(entry, member.file_size)
            return arrays
    # RuntimeError: encrypted; NotImplementedError: an unknown compression.
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError) as error:
        raise ValueError(f"expected an archive of numpy (.npz): {error}") from None
