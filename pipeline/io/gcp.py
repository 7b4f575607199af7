"""Ground control points: OpenDroneMap's ``gcp_list.txt``.

The first line names the projection. Every other line is ``x y z px py image [name]``: the point's
coordinates, its position in a photograph (stored pixels, the first pixel's centre is 0) and the
photograph's name. Source: docs.opendronemap.org/gcp.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from pipeline.io.names import NameIndex
from pipeline.runtime.errors import UserError

GCP_FILE = "gcp_list.txt"
_FIX = (
    "write the projection on the first line (WGS84 UTM 32N, EPSG:32632 or a +proj string) and "
    "'x y z px py image' on every other line"
)


@dataclass(frozen=True)
class GroundPoint:
    """A ground control point.

    Attributes:
        name: from the file, else "gcp1" and so on in the file's order.
        position: x, y, z in the file's projection (longitude, latitude, height if geographic).
        pixels: photograph's name -> pixel, COLMAP's convention (the first pixel's centre is 0.5).
    """

    name: str
    position: tuple[float, float, float]
    pixels: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class GroundControl:
    """The content of a ``gcp_list.txt``.

    Attributes:
        projection: the file's first line.
        geographic: whether coordinates are longitude and latitude in degrees, height in metres.
        unknown: names of photographs that are not in the scene.
    """

    projection: str
    geographic: bool
    points: tuple[GroundPoint, ...]
    unknown: tuple[str, ...]


def read_ground_control(path: Path, photographs: Collection[str]) -> GroundControl:
    """Read ``gcp_list.txt``.

    Args:
        photographs: names in the scene, which the file's names match with or without folder and
            suffix.

    Raises:
        UserError: the file is unreadable, has no projection or a malformed line.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot be read: {error}", file=path, fix=_FIX) from None
    rows = [(n, line.strip()) for n, line in enumerate(lines, start=1)]
    rows = [(n, line) for n, line in rows if line and not line.startswith("#")]
    if not rows or not re.match(r"(WGS84|EPSG:\d+|\+proj)", rows[0][1], re.IGNORECASE):
        raise UserError("expected a projection on the first line", file=path, fix=_FIX)
    projection = rows[0][1]
    index = NameIndex(photographs)
    by_file_name = {name.rsplit("/", 1)[-1]: name for name in photographs}
    file_name_index = NameIndex(by_file_name)
    pixels: dict[tuple[float, float, float], dict[str, tuple[float, float]]] = {}
    names: dict[tuple[float, float, float], str] = {}
    unknown = set()
    for number, line in rows[1:]:
        fields = line.split()
        try:
            x, y, z, px, py = (float(value) for value in fields[:5])
            image = fields[5]
        except (ValueError, IndexError):
            raise UserError(f"line {number} is malformed: {line}", file=path, fix=_FIX) from None
        if not all(math.isfinite(value) for value in (x, y, z, px, py)):
            raise UserError(f"line {number} is not finite: {line}", file=path, fix=_FIX)
        found = index.find(image)
        if found is None and (file_name := file_name_index.find(image)) is not None:
            found = by_file_name[file_name]
        if found is None:
            unknown.add(image)
            continue
        position = (x, y, z)
        # OpenDroneMap's pixel centres are integers.
        pixels.setdefault(position, {})[found] = (px + 0.5, py + 0.5)
        names.setdefault(position, fields[6] if len(fields) > 6 else f"gcp{len(names) + 1}")
    points = tuple(GroundPoint(names[at], at, pixels[at]) for at in pixels)
    geographic = bool(re.search(r"EPSG:4326|EPSG:4979|\+proj=longlat", projection, re.IGNORECASE))
    return GroundControl(projection, geographic, points, tuple(sorted(unknown)))
