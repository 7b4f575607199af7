"""Coordinate reference systems as users write them: kind, units and area of use, by PROJ.

Sources: docs.opendronemap.org/gcp for "WGS84 UTM 32N"; everything else (EPSG codes, PROJ strings,
WKT) is read by PROJ.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.text import shortened

if TYPE_CHECKING:
    from pyproj import CRS

Array = NDArray[np.float64]
_UTM = re.compile(r"WGS\s*[-_]?\s*84\s*[/,]?\s*UTM\s*(?:zone)?\s*(\d{1,2})\s*([A-Z]?)", re.I)
_WGS84 = re.compile(r"WGS\s*[-_]?\s*84", re.I)
# Longer texts are no name of a projection; WKT of compound systems has some thousand characters.
_MAX_LENGTH = 20_000
# Largest relative difference of a projection's lengths from true ones.
MAX_DISTORTION = 0.02
FIX = (
    "write the projection on the first line: WGS84 UTM 32N, EPSG:32632, EPSG:4326 for longitude "
    "and latitude, a +proj string or WKT on one line"
)


@dataclass(frozen=True)
class Projection:
    """A geographic or projected coordinate reference system. Coordinates are in the order
    longitude, latitude or easting, northing whatever the system's own order is.

    Attributes:
        text: The projection as the user wrote it.
        name: PROJ's name; ``text`` where it has none.
        geographic: Whether coordinates are longitude and latitude, otherwise easting and northing.
        unit: The name of the horizontal coordinates' unit.
        horizontal: The metres per unit of a projected system, the degrees of a geographic one.
        vertical: The metres per unit of heights.
        vertical_known: Whether the system says the unit of heights. Where it does not, heights are
            in the unit of projected coordinates, and in metres beside geographic ones.
        axes: The directions of the first two coordinates.
        area: The area's west, south, east and north in degrees; None if it is unknown.
        crs: PROJ's object for the system.
    """

    text: str
    name: str
    geographic: bool
    unit: str
    horizontal: float
    vertical: float
    vertical_known: bool
    axes: tuple[str, str]
    area: tuple[float, float, float, float] | None
    crs: CRS = field(compare=False, repr=False)

    @property
    def horizontal_vertical(self) -> tuple[float, float]:
        """``horizontal`` and ``vertical``."""
        return self.horizontal, self.vertical

    @property
    def in_metres(self) -> bool:
        """Whether all coordinates that are lengths are in metres."""
        return self.vertical == 1.0 and (self.geographic or self.horizontal == 1.0)

    def metres(self, coordinates: Array) -> Array:
        """(N, 3) coordinates with lengths in metres and angles in degrees."""
        return np.asarray(coordinates * [self.horizontal, self.horizontal, self.vertical])

    def longitude_latitude(self, coordinates: Array) -> Array:
        """(N, 2) degrees on WGS84 of (N, 2 or 3) coordinates; not finite outside of the
        projection's domain."""
        from pyproj import Transformer, network
        from pyproj.exceptions import ProjError

        network.set_network_enabled(active=False)
        try:
            transformer = Transformer.from_crs(self.crs, "EPSG:4326", always_xy=True)
            x, y = transformer.transform(coordinates[:, 0], coordinates[:, 1])
        except ProjError:
            return np.full((len(coordinates), 2), np.nan)
        return np.column_stack([x, y]).astype(np.float64)

    def contains(self, coordinates: Array, margin: float) -> bool:
        """Whether all of (N, 2 or 3) coordinates are in the area of use, or up to ``margin``
        degrees outside. True if the area is unknown, but for coordinates outside of the domain."""
        degrees = self.longitude_latitude(coordinates)
        if not np.isfinite(degrees).all():
            return False
        if self.area is None:
            return bool((np.abs(degrees[:, 1]) <= 90).all())
        west, south, east, north = self.area
        width = (east - west) % 360 or 360.0
        across = (degrees[:, 0] - west + margin) % 360 <= width + 2 * margin
        if width + 2 * margin >= 360:
            across[:] = True
        along = (degrees[:, 1] >= south - margin) & (degrees[:, 1] <= north + margin)
        return bool((across & along).all())

    def distortion(self, coordinates: Array) -> float:
        """Largest relative difference of lengths in a projected system from true lengths, at the
        median of the coordinates; 0 where it is unknown."""
        from pyproj import Proj
        from pyproj.exceptions import ProjError

        degrees = self.longitude_latitude(coordinates)
        if self.geographic or not np.isfinite(degrees).all():
            return 0.0
        try:
            factors = Proj(self.crs).get_factors(*np.median(degrees, axis=0))
        except ProjError:
            return 0.0
        scales = np.array([factors.tissot_semimajor, factors.tissot_semiminor])
        return float(np.abs(scales - 1).max()) if np.isfinite(scales).all() else 0.0


def read_projection(text: str) -> Projection:
    """The projection that a user wrote.

    Raises:
        ValueError: The projection is unknown, or of a kind that coordinates in metres or degrees do
            not have.
    """
    from pyproj import CRS
    from pyproj.exceptions import ProjError

    text = text.strip()
    try:
        crs = CRS.from_user_input(_standard(text))
    except (ProjError, RecursionError):
        raise ValueError(f"expected a projection, found: {shortened(text)}") from None
    if crs.is_geocentric:
        raise ValueError(
            f"{shortened(text)} has geocentric coordinates, which are not supported; convert them "
            "to longitude, latitude and height (EPSG:4979) or to a projection"
        )
    axes: list[Any] = list(crs.axis_info)
    base = crs.source_crs if crs.is_bound and crs.source_crs is not None else crs
    axes = axes or list(base.axis_info)
    if not (crs.is_geographic or crs.is_projected) or len(axes) < 2:
        raise ValueError(
            f"{shortened(text)} is neither a geographic nor a projected system ({crs.type_name})"
        )
    geographic = bool(crs.is_geographic)
    horizontal = float(axes[0].unit_conversion_factor)
    vertical = float(axes[2].unit_conversion_factor) if len(axes) > 2 else None
    if geographic:
        horizontal = float(np.degrees(horizontal))
    area = crs.area_of_use or (base.area_of_use if base is not crs else None)
    for part in crs.sub_crs_list:
        area = area or part.area_of_use
    bounds = area and (area.west, area.south, area.east, area.north)
    east = [a for a in axes[:2] if a.direction.lower() in ("east", "west")]
    north = [a for a in axes[:2] if a.direction.lower() in ("north", "south")]
    ordered = [*east, *north] if len(east) == len(north) == 1 else axes[:2]
    return Projection(
        text=text,
        name=crs.name if crs.name not in ("", "unknown", "undefined") else text,
        geographic=geographic,
        unit=str(axes[0].unit_name),
        horizontal=1.0 if abs(horizontal - 1.0) < 1e-12 else horizontal,
        vertical=(1.0 if geographic else horizontal) if vertical is None else vertical,
        vertical_known=vertical is not None,
        axes=(str(ordered[0].direction), str(ordered[1].direction)),
        area=bounds or None,
        crs=crs,
    )


def _standard(text: str) -> str:
    """OpenDroneMap's names of UTM zones as EPSG codes; other texts unchanged.

    Raises:
        ValueError: The text is no projection, or there is no such zone.
    """
    if not text or len(text) > _MAX_LENGTH or "\0" in text:
        raise ValueError(f"expected a projection, found: {shortened(text)}")
    if _WGS84.fullmatch(text):
        return "EPSG:4326"
    if utm := _UTM.fullmatch(text):
        zone, letter = int(utm[1]), utm[2].upper()
        if letter not in ("N", "S") or not 1 <= zone <= 60:
            raise ValueError(
                f"expected a UTM zone from 1 to 60 and N or S for the hemisphere, found: {text}"
            )
        return f"EPSG:{(32600 if letter == 'N' else 32700) + zone}"
    if re.fullmatch(r"epsg\s*:?\s*\d+", text, re.I):
        return f"EPSG:{re.sub(r'[^0-9]', '', text)}"
    if not re.match(r"(epsg:|urn:|ogc:|esri:|iau|\+|[a-z0-9_]+\s*\[)", text, re.I):
        raise ValueError(f"expected a projection, found: {shortened(text)}")
    return text
