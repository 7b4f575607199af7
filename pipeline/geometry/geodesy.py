"""From latitude, longitude and altitude to metres around a place: WGS84, local east-north-up."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# WGS84. Source: NIMA TR8350.2, table 3.1.
SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1 / 298.257223563
_E2 = FLATTENING * (2 - FLATTENING)


def to_ecef(geodetic: Array) -> Array:
    """(..., 3) latitude and longitude in degrees and height in metres to (..., 3) Earth-centred,
    Earth-fixed metres."""
    geodetic = np.asarray(geodetic, np.float64)
    latitude, longitude = np.radians(geodetic[..., 0]), np.radians(geodetic[..., 1])
    height = geodetic[..., 2]
    normal = SEMI_MAJOR_M / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    across = (normal + height) * np.cos(latitude)
    return np.stack(
        [
            across * np.cos(longitude),
            across * np.sin(longitude),
            (normal * (1 - _E2) + height) * np.sin(latitude),
        ],
        axis=-1,
    )


def to_enu(geodetic: Array, origin: Array) -> Array:
    """(..., 3) metres east, north and up of ``origin`` (both latitude and longitude in degrees,
    height in metres)."""
    latitude, longitude = np.radians(origin[0]), np.radians(origin[1])
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    axes = np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
    return np.asarray((to_ecef(geodetic) - to_ecef(np.asarray(origin, np.float64))) @ axes.T)
