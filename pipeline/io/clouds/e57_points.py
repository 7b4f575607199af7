"""Points of E57 files (ASTM E2807)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.io.bounded import opened_regular
from pipeline.io.clouds.e57_file import Pages, Vector, number, records
from pipeline.io.clouds.values import CHUNK_POINTS, Chunk, Chunks, damaged, stacked

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
# Points of several coordinates that vary take more bits.
_POINTS_PER_BYTE = 8
_COLOUR = ("colorRed", "colorGreen", "colorBlue")


@dataclass(frozen=True)
class _Scan:
    """The points of a scan, its pose, and the value of full intensity, if it is given."""

    points: Vector
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    full: float | None


def count_e57(path: Path) -> int:
    """Number of points according to the file's XML section.

    Raises:
        UserError: a damaged file.
    """
    with opened_regular(path) as file:
        try:
            return sum(scan.points.count for scan in _header(file)[1])
        except ValueError as error:
            raise damaged(path, str(error)) from None


def read_e57(path: Path) -> Chunks:
    """The points of all scans, each placed by its pose.

    Raises:
        UserError: a damaged file.
    """
    with opened_regular(path) as file:
        try:
            pages, scans = _header(file)
            for scan in scans:
                yield from _points(pages, scan)
        except ValueError as error:
            raise damaged(path, str(error)) from None


def _header(file: BinaryIO) -> tuple[Pages, list[_Scan]]:
    pages = Pages(file)
    scans = list(_scans(pages.root()))
    claimed, size = sum(scan.points.count for scan in scans), file.seek(0, 2)
    # Coordinates that are constant take no bytes: a small file may claim any number of points.
    if claimed > _POINTS_PER_BYTE * size:
        raise ValueError(f"expected points, found a header of {claimed} in {size} bytes")
    return pages, scans


def _scans(root: Element) -> Iterator[_Scan]:
    space = root.tag.removesuffix("e57Root")
    data = root.find(f"{space}data3D")
    if root.tag != f"{space}e57Root" or data is None:
        raise ValueError("expected an E57 file with scans (data3D), found none")
    for element in data:
        points = element.find(f"{space}points")
        if points is None:
            raise ValueError("expected points in each scan, found a scan without")
        vector = Vector.of(points, space)
        pose = _structure(element, space, "pose/rotation", "wxyz") or [1.0, 0.0, 0.0, 0.0]
        shift = _structure(element, space, "pose/translation", "xyz") or [0.0, 0.0, 0.0]
        if not any(pose):
            raise ValueError("expected a scan's rotation as a unit quaternion, found zeros")
        red = element.find(f"{space}colorLimits/{space}colorRedMaximum")
        full = None if red is None else number(red.text)
        rotation = quat_to_rotation(np.array(pose))
        yield _Scan(vector, rotation, np.array(shift), full if full and full > 0 else None)


def _structure(element: Element, space: str, path: str, names: str) -> list[float] | None:
    found = element.find("/".join(space + name for name in path.split("/")))
    return None if found is None else [number(found.findtext(space + name)) for name in names]


def _points(pages: Pages, scan: _Scan) -> Chunks:
    fields = scan.points.fields.keys()
    names = next((names for names in (_CARTESIAN, _SPHERICAL) if fields >= set(names)), None)
    if names is None:
        raise ValueError("expected scans with Cartesian or spherical coordinates, found others")
    state = names[0].replace("X", "").replace("Range", "") + "InvalidState"
    colours = _COLOUR if fields >= set(_COLOUR) else ()
    wanted = [*names, *colours, *([state] if state in fields else [])]
    for read in records(pages, scan.points, wanted, CHUNK_POINTS):
        xyz = stacked([read[name] for name in names], np.float64)
        if names is _SPHERICAL:
            xyz = _cartesian(xyz)
        # Use einsum, not a matrix product: BLAS may round differently with the number of threads.
        xyz = np.einsum("ij,nj->ni", scan.rotation, xyz) + scan.translation
        if state in read:
            xyz = np.where((read[state] == 0)[:, None], xyz, np.nan)
        colour = stacked([read[name] for name in colours], np.float32) if colours else None
        yield Chunk(xyz, colour, scan.full if colours else None)


def _cartesian(spherical: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) range, azimuth and elevation (radians) as x, y and z."""
    length, azimuth, elevation = spherical.T
    flat = length * np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), length * np.sin(elevation)], axis=1
    )
