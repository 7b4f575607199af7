"""Points of E57 files (ASTM E2807), by pye57, which is an optional package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.io.clouds.values import CHUNK_POINTS, Chunk, Chunks, damaged, stacked
from pipeline.runtime.errors import UserError

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
# Points of several coordinates that vary take more bits.
_POINTS_PER_BYTE = 8
_COLOUR = ("colorRed", "colorGreen", "colorBlue")


def read_e57(path: Path) -> Chunks:
    """The points of all scans, each placed by its pose; runs native code that may crash on
    damaged files.

    Raises:
        UserError: pye57 is not installed, or a damaged file.
    """
    try:
        from pye57 import ScanHeader, libe57
    except ImportError:
        raise UserError(
            "reading E57 files needs the package pye57, which is not installed",
            file=path,
            fix="pip install pye57, or convert the cloud to LAZ or PLY",
        ) from None
    try:
        file = libe57.ImageFile(str(path), "r")
        headers = [ScanHeader(node) for node in file.root()["data3D"]]
        _check_count(sum(header.point_count for header in headers), path)
        for header in headers:
            yield from _scan(header, file, path)
    except (libe57.E57Exception, RuntimeError, ValueError, KeyError) as error:
        raise damaged(path, f"the points cannot be read: {str(error)[:200]}") from None


def _check_count(claimed: int, path: Path) -> None:
    """Check the number of points: coordinates that are constant take no bytes, so that a small file
    may claim any number, and take days to read."""
    size = path.stat().st_size
    if claimed > _POINTS_PER_BYTE * size:
        raise damaged(path, f"expected points, found a header of {claimed} in {size} bytes")


def _scan(header: Any, file: Any, path: Path) -> Chunks:
    fields = set(header.point_fields)
    names = next((n for n in (_CARTESIAN, _SPHERICAL) if fields.issuperset(n)), None)
    if names is None:
        raise damaged(path, "expected scans with Cartesian or spherical coordinates, found others")
    state = names[0].replace("X", "").replace("Range", "") + "InvalidState"
    colours = _COLOUR if fields.issuperset(_COLOUR) else ()
    wanted = [*names, *colours, *([state] if state in fields else [])]
    buffers = _Buffers(wanted, file)
    reader = header.points.reader(buffers.vector)
    rotation, translation = header.rotation_matrix, header.translation
    full = _full(header) if colours else None
    while count := reader.read():
        read = {name: values[:count] for name, values in buffers.arrays.items()}
        xyz = stacked([read[name] for name in names], np.float64)
        if names is _SPHERICAL:
            xyz = _cartesian(xyz)
        # einsum, not a matrix product: BLAS may round differently with the number of threads.
        xyz = np.einsum("ij,nj->ni", rotation, xyz) + translation
        if state in read:
            xyz = np.where((read[state] == 0)[:, None], xyz, np.nan)
        colour = stacked([read[name] for name in colours], np.float32) if colours else None
        yield Chunk(xyz, colour, full)
    reader.close()


class _Buffers:
    """Arrays that the reader fills, ``CHUNK_POINTS`` values at a time."""

    def __init__(self, names: list[str], file: Any):
        from pye57 import libe57

        self.arrays = {name: np.zeros(CHUNK_POINTS) for name in names}
        self.vector = libe57.VectorSourceDestBuffer()
        for name, array in self.arrays.items():
            self.vector.append(libe57.SourceDestBuffer(file, name, array, CHUNK_POINTS, True, True))


def _cartesian(spherical: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) range, azimuth and elevation (radians) as x, y and z."""
    length, azimuth, elevation = spherical.T
    flat = length * np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), length * np.sin(elevation)], axis=1
    )


def _full(header: Any) -> float | None:
    """The largest value of a colour, None if the file does not say it."""
    try:
        value = float(header["colorLimits"]["colorRedMaximum"].value())
    except Exception:  # libe57 has an exception for every kind of missing node.
        return None
    return value if value > 0 else None
