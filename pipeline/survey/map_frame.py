"""The map of a georeferenced scene: a projected coordinate system, and the transformations between
it and the scene's frame.

The frame of GPS positions is a tangent plane: metres east, north and up of its origin. A point's
place on the map follows through the ellipsoid, so that the projection's scale, the convergence of
meridians and the curvature of the earth are in it. The frame of ground control points is their
projection, in metres and without its origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.geodesy import from_enu, to_enu
from pipeline.io.projection import read_projection
from pipeline.runtime.errors import UserError
from pipeline.scene.georeference import CartesianOrigin, GeographicOrigin, Georeference

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MapFrame:
    """A projected system whose coordinates are east and north, and heights.

    Attributes:
        crs: The system of horizontal coordinates, alone or with a vertical one.
        unit, height_unit: The metres per unit of horizontal coordinates and of heights.
        origin: (3,) of the scene's frame. In the map's projection, metres; or latitude, longitude
            (degrees) and height (metres) on WGS84.
        is_local: Whether the frame is a tangent plane, and ``origin`` geodetic.
        has_altitude: Whether heights are known; otherwise they are relative to the cameras.
    """

    crs: CRS
    unit: float
    height_unit: float
    origin: Array
    is_local: bool
    has_altitude: bool = True

    @property
    def name(self) -> str:
        """The system's name, with its EPSG code if it has one."""
        code = self.crs.to_epsg()
        return f"{self.crs.name} (EPSG:{code})" if code else str(self.crs.name)

    def to_map(self, xyz: Array) -> Array:
        """(N, 3) points of the scene -> east, north and height in the map's units."""
        if not self.is_local:
            return np.asarray((xyz + self.origin) / self._units)
        geodetic = from_enu(xyz, self.origin)
        east, north = self._projected().transform(geodetic[:, 1], geodetic[:, 0])
        return np.column_stack([east, north, geodetic[:, 2]])

    def to_scene(self, points: Array) -> Array:
        """(N, 3) east, north and height in the map's units -> points of the scene."""
        if not self.is_local:
            return np.asarray(points * self._units - self.origin)
        transformer = self._projected()
        longitude, latitude = transformer.transform(points[:, 0], points[:, 1], direction="INVERSE")
        return to_enu(np.column_stack([latitude, longitude, points[:, 2]]), self.origin)

    @property
    def _units(self) -> Array:
        return np.array([self.unit, self.unit, self.height_unit])

    def _projected(self) -> Transformer:
        """Longitude and latitude on WGS84 -> east and north."""
        from pyproj import Transformer

        return Transformer.from_crs("EPSG:4326", self.crs, always_xy=True)


def map_frame(georeference: Georeference) -> MapFrame:
    """The map of a scene: the projection of its ground control points, or the UTM zone of its
    origin.

    Raises:
        UserError: The projection does not count east and north.
        ValueError: The frame has no place on the earth.
    """
    from pyproj import CRS

    origin = georeference.origin
    if isinstance(origin, GeographicOrigin):
        place = np.array([origin.latitude, origin.longitude, origin.altitude or 0.0])
        crs = CRS.from_epsg(utm_code(origin.latitude, origin.longitude))
        return MapFrame(crs, 1.0, 1.0, place, True, has_altitude=origin.altitude is not None)
    if not isinstance(origin, CartesianOrigin) or georeference.projection is None:
        raise ValueError("expected a frame with a place on the earth")
    projection = read_projection(georeference.projection)
    if tuple(axis.lower() for axis in projection.axes) != ("east", "north"):
        raise UserError(
            f"maps have east and north; {projection.name} has {' and '.join(projection.axes)}",
            fix="convert the ground control points to a projection that counts east and north",
        )
    return MapFrame(projection.crs, *projection.horizontal_vertical, origin.array, is_local=False)


def utm_code(latitude: float, longitude: float) -> int:
    """The EPSG code of the UTM zone on WGS84, by the regular zones of six degrees."""
    zone = int((longitude + 180) % 360 // 6) + 1
    return (32600 if latitude >= 0 else 32700) + zone
