"""Ground control points: OpenDroneMap's ``gcp_list.txt``.

The first line names the projection. Every other line is ``x y z px py image [name]``: the point's
coordinates (easting and northing, or longitude and latitude), its position in a photograph (stored
pixels, the first pixel's centre is 0) and the photograph's name. Source: docs.opendronemap.org/gcp.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.io.bounded import MIB, read_text
from pipeline.io.names import NameIndex
from pipeline.io.projection import FIX, MAX_DISTORTION, Projection, read_projection
from pipeline.runtime.errors import UserError
from pipeline.runtime.text import shortened

GCP_FILE = "gcp_list.txt"
MAX_BYTES, MAX_LINES = 32 * MIB, 200_000
_FIX = f"{FIX}; and 'x y z px py image [name]' on every other line, separated by spaces or tabs"
_ORDER_FIX = (
    "write longitude before latitude, easting before northing, whatever the order of the "
    "projection's definition is"
)
# Degrees around a projection's area of use in which it is used nevertheless: a UTM zone.
_AREA_MARGIN = 6.0
# Pixel positions up to this far outside of the photograph are on its border.
_PIXEL_MARGIN = 1.0


Position = tuple[float, float, float]


@dataclass(frozen=True)
class GroundPoint:
    """A ground control point.

    Attributes:
        name: The name in the file, else "gcp1" and so on in the file's order.
        position: x, y in metres of the projection, or longitude, latitude in degrees on WGS84;
            z in metres.
        pixels: The pixel by the photograph's name, in COLMAP's convention (the first pixel's centre
            is 0.5).
    """

    name: str
    position: Position
    pixels: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class GroundControl:
    """The content of a ``gcp_list.txt``.

    Attributes:
        projection: The file's projection; ``points`` are in its metres or degrees.
        points: The points that a photograph of the scene shows.
        unknown: The names of photographs that are not in the scene.
        warnings: The sentences for the user.
    """

    projection: Projection
    points: tuple[GroundPoint, ...]
    unknown: tuple[str, ...]
    warnings: tuple[str, ...] = ()

    @property
    def geographic(self) -> bool:
        """Whether coordinates are longitude and latitude in degrees, height in metres."""
        return self.projection.geographic


def ground_control_file(folder: Path) -> Path | None:
    """The folder's ``gcp_list.txt`` in any case; None without one.

    Raises:
        UserError: There are two such files.
    """
    found = sorted(
        path for path in folder.iterdir() if path.name.casefold() == GCP_FILE and path.is_file()
    )
    if len(found) > 1:
        raise UserError(
            f"expected one file of ground control points, found {found[0].name} and "
            f"{found[1].name}",
            file=folder,
            fix="remove all but one of them",
        )
    return found[0] if found else None


@dataclass(frozen=True)
class _Row:
    """A line of the file: its number, the coordinates as written, the pixel as in ``GroundPoint``,
    and the words after them."""

    line: int
    position: Position
    pixel: tuple[float, float]
    words: tuple[str, ...]


def read_ground_control(
    path: Path, sizes: Mapping[str, tuple[int, int]], *, complete: bool = True
) -> GroundControl:
    """Read ``gcp_list.txt``.

    Args:
        sizes: The width and height by the photograph's name. Names match as in ``NameIndex``.
        complete: Whether these are all photographs; False if frames of videos will follow.

    Raises:
        UserError: the file is unreadable, has no projection, a malformed line, coordinates that the
            projection does not have, a name that may mean several photographs or none of the
            scene's, or a pixel outside of a photograph.
    """
    lines = _lines(path)
    if not lines:
        raise UserError("expected a projection on the first line", file=path, fix=_FIX)
    try:
        projection = read_projection(lines[0][1])
    except ValueError as error:
        raise UserError(f"line {lines[0][0]}: {error}", file=path, fix=_FIX) from None
    rows = [_row(path, number, line) for number, line in lines[1:]]
    if rows:
        _check_coordinates(path, projection, rows)
    warnings: list[str] = []
    seen: dict[Position, dict[str, tuple[float, float]]] = {}
    names: dict[Position, str] = {}
    repeated = []
    found, unknown = _in_scene(path, rows, sizes)
    for row, image, label in found:
        pixels = seen.setdefault(row.position, {})
        if pixels.get(image, row.pixel) != row.pixel:
            repeated.append(row.line)
        pixels[image] = row.pixel
        names.setdefault(row.position, label or f"gcp{len(names) + 1}")
    if repeated:
        warnings.append(
            f"{path.name}: {len(repeated)} lines repeat a point in the same photograph; the last "
            f"position is used (first: line {repeated[0]})"
        )
    if unknown and complete:
        first = shortened(unknown[0])
        if not seen:
            raise UserError(
                f"none of its {len(unknown)} photographs is in the scene (first: {first})",
                file=path,
                fix="write the photographs' file names, or set sfm.georeference: gps or none",
            )
        warnings.append(
            f"{path.name} names {len(unknown)} photographs that are not in the scene "
            f"(first: {first})"
        )
    used = Counter(name for name in names.values() if not re.fullmatch(r"[-+.\d]+", name))
    twice = sorted(name for name, count in used.items() if count > 1)
    if twice:
        warnings.append(
            f"{path.name}: {len(twice)} names of points have several positions, which are separate "
            f"points (first: {shortened(twice[0])})"
        )
    positions = _positions(projection, list(seen))
    points = tuple(
        GroundPoint(names[at], position, seen[at])
        for at, position in zip(seen, positions, strict=True)
    )
    if points and not projection.contains(np.array(list(seen)), _AREA_MARGIN):
        warnings.append(
            f"{path.name}: its points are outside of the area where {projection.name} is used: "
            "check the projection"
        )
    return GroundControl(projection, points, tuple(sorted(unknown)), tuple(warnings))


def _lines(path: Path) -> list[tuple[int, str]]:
    """Numbers and texts of the lines that are neither empty nor comments."""
    text = read_text(path, MAX_BYTES, fix=_FIX)
    # ``splitlines`` takes further characters for ends of lines; only these are.
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if len(lines) > MAX_LINES:
        raise UserError(
            f"expected at most {MAX_LINES} lines, found {len(lines)}",
            file=path,
            fix="remove the points that no photograph of the scene shows",
        )
    numbered = [(number, line.strip()) for number, line in enumerate(lines, start=1)]
    return [(number, line) for number, line in numbered if line and not line.startswith("#")]


def _row(path: Path, number: int, line: str) -> _Row:
    # Names may have spaces; in files with tabs between all fields, tabs alone separate.
    by_tab = [field.strip() for field in line.split("\t")]
    fields = by_tab if len(by_tab) >= 6 and all(by_tab[:6]) else line.split()
    try:
        x, y, z, px, py = (float(value) for value in fields[:5])
        words = tuple(fields[5:])
        if not words:
            raise ValueError
    except ValueError:
        why = "malformed"
        if re.match(r"[^\s,;]+\s*[,;]", line):
            why = "separated by commas or has decimal commas; expected spaces or tabs and points"
        raise UserError(f"line {number} is {why}: {shortened(line)}", file=path, fix=_FIX) from None
    if not all(math.isfinite(value) for value in (x, y, z, px, py)):
        raise UserError(f"line {number} is not finite: {shortened(line)}", file=path, fix=_FIX)
    # OpenDroneMap's pixel centres are integers.
    return _Row(number, (x, y, z), (px + 0.5, py + 0.5), words)


def _in_scene(
    path: Path, rows: Iterable[_Row], sizes: Mapping[str, tuple[int, int]]
) -> tuple[list[tuple[_Row, str, str]], list[str]]:
    """The lines of photographs in the scene, each with the photograph and the point's name; and the
    names of the other photographs, in the file's order.

    Raises:
        UserError: a name that may mean several photographs, or a pixel outside of one.
    """
    found: list[tuple[_Row, str, str]] = []
    unknown: dict[str, None] = {}
    outside: list[tuple[_Row, str]] = []
    index = NameIndex(sizes)
    for row in rows:
        image, label = _image(path, row, index)
        if image is None:
            unknown[row.words[0]] = None
            continue
        found.append((row, image, label))
        beyond = np.array(row.pixel) - sizes[image]
        if max(*beyond, -row.pixel[0], -row.pixel[1]) > _PIXEL_MARGIN:
            outside.append((row, image))
    if outside:
        row, image = outside[0]
        px, py = (value - 0.5 for value in row.pixel)
        width, height = sizes[image]
        raise UserError(
            f"{len(outside)} pixel positions are outside of their photograph (first: line "
            f"{row.line}, {px:g} {py:g} in {image} of {width}x{height} pixels)",
            file=path,
            fix="write positions in the stored pixels of these files (EXIF orientation not "
            "applied), not in those of photographs of another size",
        )
    return found, list(unknown)


def _image(path: Path, row: _Row, index: NameIndex) -> tuple[str | None, str]:
    """The photograph of a line and the point's name; None and "" if it is not in the scene.

    A photograph's name may have spaces: as many words as are needed belong to it.

    Raises:
        UserError: the name may mean several photographs.
    """
    for count in range(1, min(len(row.words), 8) + 1):
        listed = " ".join(row.words[:count])
        found = index.candidates(listed)
        if len(found) > 1:
            raise UserError(
                f"line {row.line}: {shortened(listed)} may mean {len(found)} photographs: "
                f"{found[0]}, {found[1]}{', ...' if len(found) > 2 else ''}",
                file=path,
                fix="write the name with its folder, as in "
                f"'{found[0]}', or give the photographs different names",
            )
        if found:
            rest = row.words[count:]
            return found[0], rest[0] if rest else ""
    return None, ""


def _positions(projection: Projection, written: list[Position]) -> list[Position]:
    """Coordinates as written -> ``GroundPoint.position``."""
    if not written:
        return []
    coordinates = np.array(written)
    found = projection.metres(coordinates)
    if projection.geographic and projection.text.upper() not in ("EPSG:4326", "EPSG:4979"):
        found[:, :2] = projection.longitude_latitude(coordinates)
    return [(x, y, z) for x, y, z in found.tolist()]


def _check_coordinates(path: Path, projection: Projection, rows: list[_Row]) -> None:
    """Check that the coordinates are possible in the projection.

    Raises:
        UserError: The coordinates are impossible; the message says so if the order is swapped.
    """
    written = np.array([row.position for row in rows])
    swapped = written[:, [1, 0, 2]]
    row = rows[0]
    shown = f"line {row.line}: {row.position[0]:.10g} {row.position[1]:.10g}"
    if projection.geographic:
        degrees = written[:, :2] * projection.horizontal
        if not _on_earth(degrees):
            if _on_earth(degrees[:, ::-1]):
                raise UserError(
                    "the coordinates are in the order latitude, longitude; expected longitude, "
                    f"latitude ({shown})",
                    file=path,
                    fix="exchange the first two columns",
                )
            bad = rows[int(np.argmax((np.abs(degrees) > [360, 90]).any(axis=1)))]
            raise UserError(
                f"{projection.name} has longitude and latitude in {projection.unit}s, and line "
                f"{bad.line} has {bad.position[0]:.10g} {bad.position[1]:.10g}",
                file=path,
                fix="write the projection that the coordinates are in on the first line, as "
                "WGS84 UTM 32N",
            )
    if projection.contains(written, _AREA_MARGIN):
        distortion = projection.distortion(written)
        if distortion > MAX_DISTORTION:
            raise UserError(
                f"lengths in {projection.name} differ from true lengths by {distortion:.0%} here",
                file=path,
                fix="convert the points to the UTM zone of the site, or to longitude and latitude",
            )
        return
    if projection.contains(swapped, _AREA_MARGIN / 6):
        order = (
            "latitude, longitude; expected longitude, latitude"
            if projection.geographic
            else "northing, easting; expected easting, northing"
        )
        raise UserError(
            f"the coordinates are in the order {order}: as written they are outside of the area "
            f"where {projection.name} is used ({shown})",
            file=path,
            fix=f"exchange the first two columns; {_ORDER_FIX}",
        )
    if not np.isfinite(projection.longitude_latitude(written)).all():
        raise UserError(
            f"the coordinates are impossible in {projection.name} ({shown})",
            file=path,
            fix="check the projection on the first line and the columns",
        )


def _on_earth(degrees: np.ndarray) -> bool:
    return bool((np.abs(degrees[:, 0]) <= 360).all() and (np.abs(degrees[:, 1]) <= 90).all())
